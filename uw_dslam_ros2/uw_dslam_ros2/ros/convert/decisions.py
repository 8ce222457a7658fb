"""What people decided, as messages and back."""

from __future__ import annotations

import math
from collections.abc import Callable

from uw_dslam_msgs.msg import Decision as DecisionMsg
from uw_dslam_msgs.msg import Transform2D

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import Decision, DecisionKind, DecisionRecord
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.ros.convert.core_types import (
    stamp_ns_from_msg,
    stamp_to_msg,
    transform2d_from_msg,
    transform2d_to_msg,
)

__all__ = ["decision_from_msg", "decision_record_from_msg", "decision_to_msg"]

_NUMBERS = ("sigma_m", "sigma_rad", "half_width_m", "half_width_rad")

StatedPose = Callable[[SubmapId, SubmapId], tuple[SE2, float, float]]
"""``T_target_source`` of two submaps by their registrations, and its standard deviations."""


def decision_to_msg(decision: Decision, is_in_force: bool = True, remark: str = "") -> DecisionMsg:
    """A decision; what the manager says of it stays as given."""
    msg = DecisionMsg(
        number=decision.number,
        kind=int(decision.kind),
        who=decision.who,
        is_run=decision.is_run,
        point_x=decision.point[0],
        point_y=decision.point[1],
        undone=decision.undone,
        is_in_force=is_in_force,
        remark=remark,
        **{name: float(getattr(decision, name)) for name in _NUMBERS},
    )
    msg.header.stamp = stamp_to_msg(decision.stamp_ns)
    msg.header.frame_id = decision.earth_frame
    for name in ("source", "target"):
        if (submap_id := getattr(decision, name)) is not None:
            setattr(msg, f"{name}_vehicle_id", submap_id.vehicle_id)
            setattr(msg, f"{name}_run_id", submap_id.run_id)
            setattr(msg, f"{name}_sequence", submap_id.sequence)
    if decision.T_target_source is not None:
        msg.t_target_source = transform2d_to_msg(decision.T_target_source)
    if decision.place is not None:
        msg.place = transform2d_to_msg(decision.place)
    return msg


def decision_from_msg(
    msg: DecisionMsg,
    newest_run: Callable[[str], int] | None = None,
    stated_pose: StatedPose | None = None,
) -> Decision:
    """A decision.

    Parameters
    ----------
    msg
        Of it.
    newest_run
        Gives the run that is meant where the message names none, from a vehicle's name.
    stated_pose
        Gives the pose that is confirmed where the message names none.

    Raises
    ------
    InvalidInputError
        Naming the field, its value and what is expected.
    """
    if msg.kind not in {int(kind) for kind in DecisionKind}:
        raise InvalidInputError(f"decision.kind is {msg.kind}, expected one of Decision's")
    kind = DecisionKind(msg.kind)
    fields = {name: float(getattr(msg, name)) for name in _NUMBERS}
    ends = {
        name: _submap_id(msg, name, newest_run)
        for name in ("source", "target")
        if getattr(msg, f"{name}_vehicle_id")
    }
    motion = None
    if kind in (DecisionKind.CONFIRM, DecisionKind.REGISTER):
        if kind is DecisionKind.CONFIRM and len(ends) == 2 and stated_pose and _says_nothing(msg):
            motion, sigma_m, sigma_rad = stated_pose(ends["source"], ends["target"])
            fields |= {
                "sigma_m": fields["sigma_m"] or sigma_m,
                "sigma_rad": fields["sigma_rad"] or sigma_rad,
            }
        else:
            motion = transform2d_from_msg(msg.t_target_source, "decision.t_target_source")
    is_fix = kind is DecisionKind.FIX
    if is_fix and fields["sigma_rad"] == 0.0:
        fields["sigma_rad"] = math.inf
    return Decision(
        kind,
        msg.who,
        stamp_ns_from_msg(msg.header.stamp),
        ends.get("source"),
        ends.get("target"),
        bool(msg.is_run),
        motion,
        point=(float(msg.point_x), float(msg.point_y)),
        place=transform2d_from_msg(msg.place, "decision.place") if is_fix else None,
        earth_frame=msg.header.frame_id,
        undone=int(msg.undone),
        number=int(msg.number),
        **fields,
    )


def decision_record_from_msg(msg: DecisionMsg) -> DecisionRecord:
    """A decision that the manager listed, and what became of it."""
    return DecisionRecord(decision_from_msg(msg), bool(msg.is_in_force), msg.remark)


def _says_nothing(msg: DecisionMsg) -> bool:
    motion: Transform2D = msg.t_target_source
    return any(math.isnan(value) for value in (motion.x, motion.y, motion.yaw))


def _submap_id(msg: DecisionMsg, name: str, newest_run: Callable[[str], int] | None) -> SubmapId:
    vehicle_id, run_id = getattr(msg, f"{name}_vehicle_id"), int(getattr(msg, f"{name}_run_id"))
    if not run_id and newest_run is not None:
        run_id = newest_run(vehicle_id)
    return SubmapId(vehicle_id, run_id, int(getattr(msg, f"{name}_sequence")))
