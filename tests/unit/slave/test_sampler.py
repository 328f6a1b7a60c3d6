"""Background reading of probes: no probe delays the loop or another probe's readings."""

import threading
import time

import pytest

from rosrm.extensions.made import FailedProbe
from rosrm.model.values import RESOURCE_SLOTS, Reading, ResourceDescription
from rosrm.slave.sampler import ANOTHER_ERROR, REPORTS, TRUSTED_AFTER, Sampler
from rosrm.testing import FakeClock, FakeProbe, made_probe
from tests.waiting import PATIENCE, wait_until

TICK = 0.1


class Rig:
    """Sampler with its clock, called like in the slave's 10 Hz loop."""

    def __init__(self, **probes):
        self.clock = FakeClock()
        made = [
            made_probe(name, *probe) if isinstance(probe, tuple) else made_probe(name, probe)
            for name, probe in probes.items()
        ]
        self.sampler = Sampler(made, clock=self.clock)
        self.reports = []

    def tick(self, count=1, *, settle=True):
        """Run cycles of the loop; with `settle` every pending read may end after each cycle."""
        for _ in range(count):
            sample = self.sampler.latest(self.clock.advance(TICK))
            self.reports += [str(report) for report in sample.reports]
            if settle:
                assert self.sampler.settle(PATIENCE)
        return sample

    def threads(self):
        return sum(thread.name.startswith("rosrm-probe") for thread in threading.enumerate())


@pytest.fixture
def rig():
    """Make rigs, and release every hanging probe in the end."""
    rigs = []
    before = {thread.ident for thread in threading.enumerate()}

    def make(**probes):
        rigs.append((Rig(**probes), probes))
        return rigs[-1][0]

    yield make
    for made, probes in rigs:
        for probe in probes.values():
            if isinstance(probe, FakeProbe):
                probe.gate.set()
        made.sampler.settle(PATIENCE)
        made.sampler.close()
    end = time.monotonic() + PATIENCE
    for thread in threading.enumerate():
        if thread.ident not in before:
            thread.join(max(0.0, end - time.monotonic()))
    assert {thread.ident for thread in threading.enumerate()} <= before


@pytest.fixture
def bad(rig):
    """Make a rig of one probe that has answered twice, and is then changed by the test."""
    probe = FakeProbe(cpu=0.25)
    made = rig(bad=probe)
    made.tick(2)
    return probe, made


def test_readings_lie_in_the_slots_of_their_resources(rig):
    """The order of probes and resources defines the slots; unused ones are 0 and not present."""
    made = rig(a=FakeProbe(cpu=0.25, memory=0.5), b=FakeProbe(disk=0.75))
    sample = made.sampler.first(PATIENCE)
    assert [resource.name for resource in made.sampler.resources] == ["cpu", "memory", "disk"]
    assert list(sample.usage) == [0.25, 0.5, 0.75] + [0.0] * (RESOURCE_SLOTS - 3)
    assert (sample.stale, made.sampler.present) == (0, 0b111)


def test_full_and_stale_before_the_first_reading(rig):
    """An unmeasured host does not look empty."""
    probe = FakeProbe(cpu=0.1)
    probe.gate.clear()
    sample = rig(a=probe).tick(settle=False)
    assert (sample.usage[0], sample.stale) == (1.0, 1)


def test_sample_is_not_changed_by_later_ones(rig):
    """A sample that was taken does not change."""
    probe = FakeProbe(cpu=0.1)
    made = rig(a=probe)
    sample = made.sampler.first(PATIENCE)
    probe.answer = {"cpu": 0.9}
    made.tick(3)
    assert sample.usage[0] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        ({"cpu": float("nan")}, "usage nan of 'cpu'"),
        ({"cpu": float("inf")}, "usage inf of 'cpu'"),
        ({"cpu": -0.1}, "usage -0.1 of 'cpu'"),
        ({"cpu": 1e6}, "usage 1000000.0 of 'cpu'"),
        ({"cpu": "full"}, "usage 'full' of 'cpu'"),
        ({"cpu": None}, "usage None of 'cpu'"),
        ({"cpu": {}}, "a fraction of its capacity is required, 1.0 where it is full and at most 6"),
        ({}, "no reading of cpu"),
        ({"cpu": 0.1, "gpu": 0.1}, "'gpu', which it did not announce"),
    ],
)
def test_nonsense_makes_the_reading_stale_not_zero(rig, answer, reason):
    """The probe keeps its last value, is stale, and is reported once."""
    probe = FakeProbe(cpu=0.25)
    made = rig(bad=probe, good=FakeProbe(memory=0.5))
    made.tick(2)
    probe.answer = answer
    sample = made.tick(10)
    assert (sample.usage[0], sample.stale) == (0.25, 0b01)
    assert len(made.reports) == 1
    assert made.reports[0].startswith("probe bad: cpu stale: ")
    assert reason in made.reports[0]


@pytest.mark.parametrize("fault", [OSError("no such device"), SystemExit(3), AssertionError()])
def test_raising_probe_is_stale_and_recovers(bad, fault):
    """After any exception the readings are stale until the next answer; both are reported."""
    probe, made = bad
    probe.fault = fault
    assert made.tick(5).stale == 1
    probe.fault, probe.answer = None, {"cpu": 0.5}
    sample = made.tick(3)
    assert (sample.usage[0], sample.stale) == (0.5, 0)
    assert type(fault).__name__ in made.reports[0]
    assert made.reports[1:] == ["probe bad: cpu read again"]


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (None, "answered None; a list of Readings is required"),
        ([0.5], "answered a float; Reading is required"),
        ([Reading("cpu", 0.1), Reading("cpu", 0.2)], "two readings of 'cpu'"),
    ],
)
def test_an_answer_that_is_not_one_reading_of_each_resource_is_named(bad, answer, reason):
    """A missing `return` or `Reading` gives a message with the place of `read`."""
    probe, made = bad
    probe.read = lambda: answer
    assert made.tick(3).stale == 1
    place = f"{__file__}:{probe.read.__code__.co_firstlineno}"
    assert made.reports == [f"probe bad: cpu stale: {reason} ({place})"]


def test_the_place_at_which_a_probe_raised_is_reported(bad):
    """The report has the plugin's own file and line."""
    probe, made = bad

    def read():
        raise OSError("no such sensor")

    probe.read = read
    made.tick(2)
    (report,) = made.reports
    line = read.__code__.co_firstlineno + 1
    assert report.endswith(f"read() raised OSError: no such sensor ({__file__}:{line})")


def test_generator_that_raises_midway_changes_nothing(rig):
    """All values of a read are used, or none."""
    probe = FakeProbe(cpu=0.25, memory=0.5)
    made = rig(bad=probe)
    made.tick(2)

    def read():
        yield Reading("cpu", 0.9)
        raise OSError("gone")

    probe.read = read
    sample = made.tick(3)
    assert list(sample.usage[:2]) == [0.25, 0.5]
    assert sample.stale == 0b11


def test_hanging_probe_is_late_after_its_deadline_and_not_asked_again(bad):
    """The last reading counts until the deadline; then it is stale until the probe answers.

    The probe costs one thread and one read, however long it hangs.
    """
    probe, made = bad
    probe.gate.clear()
    reads = probe.reads + 1
    made.tick(1, settle=False)
    wait_until(lambda: probe.reads == reads, "the read that hangs")
    assert made.tick(9, settle=False).stale == 0
    sample = made.tick(3, settle=False)
    assert (sample.usage[0], sample.stale) == (0.25, 1)
    assert made.reports == ["probe bad: cpu stale: no answer within 1 s"]
    made.tick(100, settle=False)
    assert (probe.reads, made.threads()) == (reads, 1)
    probe.gate.set()
    assert made.tick(3).stale == 0


@pytest.mark.parametrize("trusted", [False, True])
def test_hanging_probe_delays_no_other(rig, trusted):
    """In a shared thread the others miss one cycle, and are read in the next."""
    slow, before, after = FakeProbe(slow=0.1), FakeProbe(before=0.1), FakeProbe(after=0.1)
    made = rig(before=before, slow=slow, after=after)
    made.tick(TRUSTED_AFTER + 2 if trusted else 1)
    wait_until(lambda: made.threads() == (1 if trusted else 3), "threads of trusted probes")
    slow.gate.clear()
    before.answer, after.answer = {"before": 0.7}, {"after": 0.8}
    reads = slow.reads
    made.tick(1, settle=False)
    wait_until(lambda: slow.reads > reads, "a read of the slow probe")
    made.tick(1, settle=False)
    wait_until(
        lambda: not any(w.busy for w in made.sampler._watched if w.name != "slow"),
        "the reads of the quick probes",
    )
    sample = made.tick(1, settle=False)
    assert list(sample.usage[:3]) == pytest.approx([0.7, 0.1, 0.8])
    assert sample.stale == 0
    wait_until(lambda: made.threads() == (2 if trusted else 3), "a new thread of the queue")


def test_latest_never_waits(rig):
    """The loop gets its answer at once while every probe hangs."""
    probes = {name: FakeProbe(**{name: 0.1}) for name in "abcd"}
    made = rig(**probes)
    made.tick(TRUSTED_AFTER + 2)
    for probe in probes.values():
        probe.gate.clear()
    times = []
    for _ in range(50):
        begun = time.perf_counter()
        made.tick(1, settle=False)
        times.append(time.perf_counter() - begun)
    # The bound is far above a call and far below a wait; a busy machine may stall many calls.
    assert sorted(times)[25] < 0.05, times
    wait_until(lambda: made.threads() <= len(probes) + 1, "one thread for each probe")


def test_quick_probes_come_to_share_a_thread(rig):
    """After some quick reads one thread, and so one wake-up a cycle, serves all probes."""
    made = rig(**{name: FakeProbe(**{name: 0.1}) for name in "abcd"})
    made.tick(1)
    assert made.threads() == 4
    made.tick(TRUSTED_AFTER + 1)
    wait_until(lambda: made.threads() == 1, "1 thread of probes")


def test_slow_read_costs_the_place_in_the_shared_thread(rig):
    """One long read is enough, even if no other probe waited."""

    class Slow(FakeProbe):
        seconds = 0.0

        def read(self):
            made.clock.advance(self.seconds)
            return super().read()

    slow, made = Slow(slow=0.1), None
    made = rig(slow=slow, quick=FakeProbe(quick=0.1))
    made.tick(TRUSTED_AFTER + 2)
    wait_until(lambda: made.threads() == 1, "1 thread of probes")
    slow.seconds = 0.06
    made.tick(3)
    wait_until(lambda: made.threads() == 2, "2 threads of probes")
    slow.seconds = 0.0
    made.tick(TRUSTED_AFTER + 2)
    wait_until(lambda: made.threads() == 1, "1 thread of probes")


def test_late_answer_is_kept_but_stale(rig):
    """A late answer replaces an older value, but counts as stale."""

    class Late(FakeProbe):
        def read(self):
            made.clock.advance(1.5)
            return super().read()

    made = rig(late=Late(cpu=0.25))
    sample = made.tick(3)
    assert (sample.usage[0], sample.stale) == (0.25, 1)
    assert "answered after 1.5 s" in made.reports[0]


def test_a_failure_is_reported_at_once_however_often_the_probe_changed(bad):
    """Only recoveries are delayed, so a probe that fails for good is shown as stale."""
    probe, made = bad
    for cycle in range(20):
        probe.fault = OSError("flaps") if cycle % 2 else None
        made.tick(2)
        probe.fault = OSError("gone for good")
        assert made.tick(2).stale == 1
        assert "stale: " in made.reports[-1]


def test_another_error_is_reported_after_a_while(bad):
    """The newest error is reported, so that the listing shows no corrected one."""
    probe, made = bad
    for error in ("unplugged", "no permission"):
        probe.fault = OSError(error)
        made.tick(2)
    assert len(made.reports) == 1
    made.clock.advance(ANOTHER_ERROR)
    made.tick(5)
    assert len(made.reports) == 2
    assert "no permission" in made.reports[1]


def test_a_probe_that_could_not_be_made_is_full_and_stale(rig):
    """The readings of a failed probe are as before a first answer.

    If others read all of its resources, it only fails.
    """
    lidar = FailedProbe([ResourceDescription("lidar", "1", 1.0)], "plugin 'acme': no `read`")
    made = rig(lidar=lidar, none=FailedProbe([], "plugin 'acme': reads 'cpu', as ..."))
    sample = made.tick(3)
    assert (sample.usage[0], sample.stale) == (1.0, 1)
    assert made.reports == [
        "probe lidar: lidar stale: plugin 'acme': no `read`",
        "probe none fails: plugin 'acme': reads 'cpu', as ...",
    ]


def test_a_probe_takes_the_place_of_its_substitute_and_the_others_keep_their_readings():
    """Its resources may be others than declared, so that the slots of the others change."""
    cpu, clock = made_probe("cpu", FakeProbe(cpu=0.25)), FakeClock()
    declared = [ResourceDescription(name, "1", 1.0) for name in ("lidar", "heat")]
    stand_in = made_probe("lidar", FailedProbe(declared, "not created yet"))
    sampler = Sampler([stand_in, cpu], clock=clock)
    sampler.first(PATIENCE)
    assert sampler.latest(clock.advance(TICK)).usage[:3].tolist() == [1.0, 1.0, 0.25]
    made = made_probe("lidar", FakeProbe(lidar=0.5))
    assert sampler.rearrange([made, cpu]) == (stand_in,)
    assert [one.name for one in sampler.resources] == ["lidar", "cpu"]
    sample = sampler.latest(clock.advance(TICK))
    assert (sample.usage[:3].tolist(), sample.stale) == ([1.0, 0.25, 0.0], 1), "full and stale"
    assert sampler.settle(PATIENCE)
    sample = sampler.latest(clock.advance(TICK))
    assert (sample.usage[:3].tolist(), sample.stale) == ([0.5, 0.25, 0.0], 0)
    assert sampler.settle(PATIENCE)
    assert sampler.close() == ()


def test_probe_is_read_once_a_period():
    """A probe of a longer period is not read in every cycle, and jitter skips none."""
    quick, seldom = FakeProbe(quick=0.1), FakeProbe(seldom=0.1)
    clock = FakeClock()
    sampler = Sampler(
        [made_probe("quick", quick), made_probe("seldom", seldom, period=1.0)], clock=clock
    )
    for cycle in range(100):
        sampler.latest(clock.advance(0.1 + (0.02 if cycle % 2 else -0.02)))
        sampler.settle(PATIENCE)
    sampler.close()
    assert quick.reads == 100
    assert 9 <= seldom.reads <= 11


def test_flapping_probe_floods_nothing(bad):
    """A probe that fails at every second read causes a few reports a minute.

    Its readings are stale as the newest report states, so that both listings show the same.
    """
    probe, made = bad
    for cycle in range(200):
        probe.fault = OSError("flaps") if cycle % 2 else None
        sample = made.tick(1)
        reported = bool(made.reports) and "read again" not in made.reports[-1]
        assert bool(sample.stale) is reported
    assert len(made.reports) <= REPORTS
    assert "changes often" in made.reports[-1]
    probe.fault = None
    made.clock.advance(60.0)
    assert made.tick(2).stale == 0
    probe.fault = OSError("again")
    made.tick(2)
    assert "again" in made.reports[-1]


def test_close_closes_each_probe_once():
    """The thread that read the probe closes it; a `close` that raises stops no other."""
    good, bad = FakeProbe(good=0.1), FakeProbe(bad=0.1)
    bad.close = lambda: 1 / 0
    sampler = Sampler([made_probe("bad", bad), made_probe("good", good)])
    sampler.first(PATIENCE)
    assert sampler.close() == ("bad",)
    assert good.closed == 1


def test_close_does_not_wait_for_a_hanging_probe():
    """The hanging probe stays open, and its name is returned."""
    slow, good = FakeProbe(slow=0.1), FakeProbe(good=0.1)
    slow.gate.clear()
    sampler = Sampler([made_probe("slow", slow), made_probe("good", good)])
    sampler.first(timeout=0.05)
    begun = time.monotonic()
    assert sampler.close(timeout=1.0) == ("slow",)
    assert time.monotonic() - begun < 10.0
    assert (slow.closed, good.closed) == (0, 1)
    slow.gate.set()


def test_probe_is_not_closed_under_its_own_read(rig):
    """A thread other than the one in which it hangs does not close it either."""
    slow, good = FakeProbe(slow=0.1), FakeProbe(good=0.1)
    made = rig(slow=slow, good=good)
    made.tick(TRUSTED_AFTER + 2)
    slow.gate.clear()
    reads = slow.reads
    made.tick(1, settle=False)
    wait_until(lambda: slow.reads > reads, "a read of the slow probe")
    made.tick(2, settle=False)
    assert made.sampler.close(timeout=2.0) == ("slow",)
    assert (slow.closed, good.closed) == (0, 1)


def test_unread_sampler_closes():
    """A slave that ends before its first cycle closes its probes all the same."""
    probe = FakeProbe(cpu=0.1)
    assert Sampler([made_probe("a", probe)]).close() == ()
    assert probe.closed == 1


def test_no_probes():
    """A host without probes has an empty sample."""
    sampler = Sampler([])
    sample = sampler.first(PATIENCE)
    assert (sample.stale, sampler.present, sum(sample.usage)) == (0, 0, 0.0)
    assert sampler.close() == ()
