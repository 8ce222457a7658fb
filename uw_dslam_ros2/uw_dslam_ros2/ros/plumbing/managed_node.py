"""Nodes with a life cycle that go through it by themselves, unless they are told to wait."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from typing import Any, ClassVar

from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.service import Service

from uw_dslam_ros2.core.config import Config
from uw_dslam_ros2.core.errors import ConfigError, UwDslamError
from uw_dslam_ros2.ros.plumbing.diagnostics import Diagnostics, Report
from uw_dslam_ros2.ros.plumbing.parameters import (
    declare_config,
    held_config,
    refuse_unknown_parameters,
    settings_of,
)
from uw_dslam_ros2.ros.plumbing.qos_overrides import QosOverrides

__all__ = ["ManagedNode"]

_ENTITIES = ("publisher", "subscription", "client", "service", "timer")
_WOKEN_BY = ("subscription", "timer")
_ANSWERS_S, _SENT_S = 5.0, 0.1
"""Longest wait for callbacks that answer a request, and until their answers are sent."""
_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class ManagedNode(QosOverrides, LifecycleNode):
    """Base of nodes that are configured, activated, deactivated and cleaned up (ROS 2 life cycle).

    A node says in `groups` which settings it has, and does its work in `set_up`, `begin` and
    `rest`. Subscriptions and timers that it creates while it is active are destroyed when it is
    deactivated, all publishers, services and the like when it is cleaned up. What else has to be
    ended says `at_end`.

    Raises
    ------
    UwDslamError
        By the constructor, if a setting cannot be used; with `autostart` also what `set_up` and
        `begin` raise.
    """

    groups: ClassVar[Sequence[tuple[str, type[Config]]]] = ()
    """Prefix and type of each group of settings; "" stands for the node's own, which come first
    and have `autostart`."""
    live: ClassVar[frozenset[str]] = frozenset()
    """Parameters that may change while it runs, or ``<prefix>.*`` for a whole group; all others
    wait for the next configuration."""
    why_fixed: ClassVar[str] = ""
    """Why the others may not, as the end of a sentence."""

    def __init__(self, name: str, **kwargs: Any) -> None:
        self._answering, self._num_answering = threading.Condition(), 0
        super().__init__(name, **kwargs)
        self._settings: dict[str, Config] = {
            prefix: declare_config(self, config_type, prefix, is_read_only=False)
            for prefix, config_type in self.groups
        }
        refuse_unknown_parameters(self)
        self._names = {
            name
            for prefix, config_type in self.groups
            for name, *_ in settings_of(config_type, prefix)
        }
        self._is_set_up = False
        self._is_active = False
        self._is_starting = False
        self._problem: Exception | None = None
        self._closing = ExitStack()
        self._before: set[Any] = set()
        self._before_active: set[Any] = set()
        self.add_on_set_parameters_callback(self._on_parameters)
        self.add_post_set_parameters_callback(self._on_parameters_set)
        if self.get_parameter("autostart").value:
            self._go_through()

    def _go_through(self) -> None:
        self._is_starting = True
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() != _SUCCESS:
                raise self._problem or UwDslamError(f"{self.get_name()} could not be started")
        self._is_starting = False

    # --- what a node does --------------------------------------------------------------------

    def set_up(self) -> None:
        """Make all that the node needs, by its settings."""
        raise NotImplementedError

    def begin(self) -> None:
        """Begin to take and give."""

    def rest(self) -> None:
        """Take and give no more; what is known is kept."""

    def at_end(self, close: Callable[[], None]) -> None:
        """In `set_up`: have something ended when the node is cleaned up, the last thing first."""
        self._closing.callback(close)

    def settings_changed(self) -> None:
        """A setting of `live` has another value now."""

    # --- settings ----------------------------------------------------------------------------

    def settings[ConfigT: Config](self, config_type: type[ConfigT]) -> ConfigT:
        """A group of settings as it is now."""
        return next(config for config in self._settings.values() if type(config) is config_type)

    def _on_parameters(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        given = {parameter.name: parameter.value for parameter in parameters}
        own = {name: value for name, value in given.items() if name in self._names}
        if not own:
            return SetParametersResult(successful=True)
        fixed = sorted(name for name in own if self._is_set_up and not self._is_live(name))
        if fixed:
            return SetParametersResult(
                successful=False,
                reason=f"{fixed[0]} cannot change while {self.get_name()} is configured: "
                f"{self.why_fixed}; set it at the start or after a clean-up",
            )
        try:
            for prefix, config_type in self.groups:
                held_config(self, config_type, prefix, own)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _is_live(self, name: str) -> bool:
        return name in self.live or f"{name.partition('.')[0]}.*" in self.live

    def _on_parameters_set(self, parameters: Sequence[Parameter]) -> None:
        if any(parameter.name in self._names for parameter in parameters):
            self._read_settings()
            if self._is_set_up:
                self.settings_changed()

    def _read_settings(self) -> None:
        self._settings = {
            prefix: held_config(self, config_type, prefix) for prefix, config_type in self.groups
        }

    # --- the life cycle ----------------------------------------------------------------------

    @property
    def is_active(self) -> bool:
        """Whether it takes and gives."""
        return self._is_active

    def on_configure(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Set everything up."""
        return self._try(self._configure, self._unmake)

    def on_activate(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Begin."""
        return self._try(self._activate, self._deactivate)

    def on_deactivate(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Rest."""
        return self._try(self._deactivate, self._deactivate)

    def on_cleanup(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Unmake everything."""
        return self._try(self._unmake, self._unmake)

    def on_shutdown(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Unmake everything, for good."""
        return self._try(self._unmake, self._unmake)

    def _configure(self) -> None:
        self._before = self._entities()
        self.set_up()
        self.check_qos_overrides()
        self._is_set_up = True

    def _activate(self) -> None:
        self._before_active = self._entities()
        self._is_active = True
        self.begin()

    def _deactivate(self) -> None:
        if self._is_active:
            self._is_active = False
            self._destroy(self._entities(_WOKEN_BY) - self._before_active)
            self.rest()

    def _unmake(self) -> None:
        self._deactivate()
        self.stop()
        self._wait_for_answers()
        self._destroy(self._entities() - self._before)

    def _try(self, act: Callable[[], None], mend: Callable[[], None]) -> TransitionCallbackReturn:
        """Do a transition; one that fails is undone, and says why."""
        self._problem = None
        try:
            act()
        except Exception as error:  # noqa: BLE001 (who asked for it gets a refusal)
            self._problem = error
            is_told = isinstance(error, UwDslamError)
            if not self._is_starting:  # else it is raised
                self.get_logger().error(str(error) if is_told else traceback.format_exc())
            mend()
            return _FAILURE
        return _SUCCESS

    def stop(self) -> None:
        """End threads, keep what is to be kept; the second time nothing."""
        self._is_set_up = False
        self._closing.close()

    def destroy_node(self) -> None:
        """Stop, then destroy."""
        self.stop()
        super().destroy_node()

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Any, **kwargs: Any
    ) -> Service:
        """As the base class; it is not destroyed under a request that is being answered."""

        def answer(request: Any, response: Any) -> Any:
            with self._answering:
                self._num_answering += 1
            try:
                return callback(request, response)
            finally:
                with self._answering:
                    self._num_answering -= 1
                    self._answering.notify_all()

        return super().create_service(srv_type, srv_name, answer, **kwargs)

    def _wait_for_answers(self) -> None:
        with self._answering:
            self._answering.wait_for(lambda: self._num_answering == 0, _ANSWERS_S)
        time.sleep(_SENT_S)

    def _entities(self, kinds: Sequence[str] = _ENTITIES) -> set[Any]:
        return {entity for kind in kinds for entity in getattr(self, f"{kind}s")}

    def _destroy(self, entities: Iterable[Any]) -> None:
        for entity in entities:
            for kind in _ENTITIES:
                if entity in getattr(self, f"{kind}s"):
                    getattr(self, f"destroy_{kind}")(entity)

    def tell_health(self, make_report: Callable[[], Report], hardware_id: str) -> None:
        """Publish on ``/diagnostics``, as long as the node is configured."""

        def report() -> Report:
            severity, text, values = make_report()
            return (
                (severity, text, values)
                if self._is_active
                else ("warning", f"inactive; {text}", values)
            )

        self._diagnostics = Diagnostics(self, report, hardware_id)
