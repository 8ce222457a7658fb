"""What the nodes' threads are made of: the worker, the jobs, the pacer."""

import threading
import time

import pytest

pytest.importorskip("rclpy")

from uw_dslam_ros2.core.registration.result import RegistrationResult, Verdict
from uw_dslam_ros2.ros.plumbing.playback import Pacer
from uw_dslam_ros2.ros.plumbing.registration_jobs import RegistrationJobs
from uw_dslam_ros2.ros.plumbing.worker import Worker

pytestmark = pytest.mark.ros

PATIENCE_S = 10.0


def test_worker_does_jobs_in_order_in_one_thread():
    worker, done = Worker("test", print), []
    for number in range(100):
        worker.post(lambda n=number: done.append((n, threading.get_ident())))
    assert worker.call(lambda: len(done)).result(PATIENCE_S) == 100
    worker.close(PATIENCE_S)
    assert [number for number, _ in done] == list(range(100))
    assert len({thread for _, thread in done}) == 1


def test_worker_survives_a_bad_job_and_tells():
    told = []
    worker = Worker("test", told.append)
    worker.post(lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        worker.call(lambda: 1 // 0).result(PATIENCE_S)
    assert worker.call(lambda: "alive").result(PATIENCE_S) == "alive"
    worker.close(PATIENCE_S)
    assert [type(error) for error in told] == [ZeroDivisionError]


def test_worker_survives_whoever_gives_up_waiting():
    worker, begun, gate = Worker("test", print), threading.Event(), threading.Event()
    done = []

    def job():
        begun.set()
        return gate.wait(PATIENCE_S)

    running = worker.call(job)
    waiting = worker.call(lambda: done.append("begun though nobody waits"))
    assert begun.wait(PATIENCE_S)
    assert waiting.cancel()
    assert not running.cancel()
    gate.set()
    assert running.result(PATIENCE_S)
    assert worker.call(lambda: "alive").result(PATIENCE_S) == "alive"
    worker.close(PATIENCE_S)
    assert not done


def test_closing_worker_cancels_what_waits():
    worker, begun, gate = Worker("test", print), threading.Event(), threading.Event()

    def job():
        begun.set()
        return gate.wait(PATIENCE_S)

    running = worker.call(job)
    waiting = worker.call(lambda: "never")
    assert begun.wait(PATIENCE_S)
    closer = threading.Thread(target=worker.close)
    closer.start()
    deadline_s = time.monotonic() + PATIENCE_S
    while worker.num_waiting < 2:  # the job, and the word that it is over
        assert time.monotonic() < deadline_s
    gate.set()
    closer.join(PATIENCE_S)
    assert running.result(PATIENCE_S)
    assert waiting.cancelled()


def test_closing_jobs_ends_the_searches():
    jobs, begun = RegistrationJobs(max_parallel=1, max_waiting=1), threading.Event()

    def search(*, progress, is_cancelled):  # noqa: ARG001 (the form of a search)
        begun.set()
        while not is_cancelled():
            pass
        return RegistrationResult.refused(Verdict.BUDGET_EXHAUSTED, "cancelled")

    first, second = jobs.submit(search), jobs.submit(search)
    assert begun.wait(PATIENCE_S)
    assert jobs.submit(search) is None
    assert (jobs.counts.num_running, jobs.counts.num_waiting) == (1, 1)
    jobs.close()
    assert first.wait(PATIENCE_S)
    assert second.wait(PATIENCE_S)
    assert jobs.submit(search) is None


class Clock:
    """Time that passes by a step with every look."""

    def __init__(self, step_s):
        self.now_s, self.step_s = 100.0, step_s

    def __call__(self):
        self.now_s += self.step_s
        return self.now_s


@pytest.mark.parametrize("rate", [0.5, 1.0, 4.0])
def test_pacer_keeps_the_rate(rate):
    clock = Clock(0.001)
    pacer = Pacer(rate, clock, lambda: False)
    dues_s = []
    for tenth in range(11):
        assert pacer.wait_for(tenth * 10_000_000)
        dues_s.append(clock.now_s)
    assert dues_s[-1] - dues_s[0] == pytest.approx(0.1 / rate, abs=0.01)
    assert dues_s == sorted(dues_s)


def test_pacer_does_not_make_up_for_a_stall():
    clock = Clock(0.001)
    pacer = Pacer(1.0, clock, lambda: False)
    assert pacer.wait_for(0)
    clock.now_s += 5.0
    assert pacer.wait_for(10_000_000)
    resumed_s = clock.now_s
    assert pacer.wait_for(60_000_000)
    assert clock.now_s - resumed_s == pytest.approx(0.05, abs=0.01)


def test_stopped_pacer_lets_go():
    pacer = Pacer(1.0, Clock(0.001), lambda: True)
    pacer.set_paused(True)
    assert not pacer.wait_for(0)
