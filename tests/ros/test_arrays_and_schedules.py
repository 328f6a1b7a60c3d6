"""Arrays and schedules with a real master, slaves and processes, from work files."""

from __future__ import annotations

from collections import defaultdict

from rosrm.config.work import load_work
from tests.ros.clusters import host
from tests.waiting import wait_until

#: Each job notes its start and its end in a file. Index 3 fails always.
ARRAY = """
processes:
  - name: render
    kind: job
    array: 1-6
    parallel: 2
    restart: {when: on-failure, attempts: 2, delay: 0.1s}
    stop: {interrupt_grace: 0.5s, terminate_grace: 0.5s}
    command:
      - sh
      - -c
      - |-
        echo "begin $ROSRM_ARRAY_INDEX" >> LOG; sleep 0.3; echo "end {array.index}" >> LOG
        test {array.index} != 3
"""
SCHEDULES = """
processes:
  - {name: often, kind: job, every: 1s, command: "true"}
  - {name: daily, kind: job, at: "03:00", command: "true"}
"""


def test_an_array_runs_two_jobs_at_a_time_and_retries_the_one_that_fails(
    make_cluster, tmp_path
) -> None:
    """Each job has its index in its texts and its environment."""
    cluster, log = make_cluster(host("a"), host("b")), tmp_path / "log"
    work = tmp_path / "work.yaml"
    work.write_text(ARRAY.replace("LOG", str(log)))
    specs = load_work(work)
    cluster.submit(*specs)
    found = {spec.name: cluster.ended(spec.name) for spec in specs}
    assert {row.array for row in found.values()} == {"render"}
    failed = found.pop("render-3")
    assert (failed.state, failed.exit_code, failed.restarts) == ("failed", 1, 2)
    assert {row.state for row in found.values()} == {"finished"}
    runs: dict[str, list[str]] = defaultdict(list)
    going = 0
    for line in log.read_text().splitlines():
        what, index = line.split()
        runs[index].append(what)
        going += 1 if what == "begin" else -1
        assert 0 <= going <= 2
    assert runs.pop("3") == ["begin", "end"] * 3
    assert runs == {index: ["begin", "end"] for index in "12456"}


def test_a_job_starts_again_every_second_and_another_waits_for_its_time(
    make_cluster, tmp_path
) -> None:
    """The time of day has the zone of the machine; a cancellation ends both."""
    cluster, work = make_cluster(host("a")), tmp_path / "work.yaml"
    work.write_text(SCHEDULES)
    said = cluster.submit(*load_work(work))
    assert said == "1 process queued; 1 process waits for the first run"
    cluster.wait_for_event("queued", "often is queued for its run at", process="often")

    def finished() -> int:
        view = cluster.client.list(events=True, process="often")
        return sum(event.kind == "finished" for event in view.events)

    wait_until(lambda: finished() >= 3, "three runs of often have finished")
    row = cluster.wait("often", "scheduled")
    assert (row.exit_code, row.host, row.next_run > 0.0) == (0, "a", True)
    reason = cluster.wait("daily", "scheduled").reason
    assert reason.startswith("next run at 03:00 ")
    assert "`rosrm restart daily` starts a run now" in cluster.client.explain("daily")["advice"]
    cluster.client.restart(["daily"])
    cluster.wait_for_event("finished", process="daily")
    cluster.wait("daily", "scheduled")
    cluster.client.cancel(["often", "daily"])
    for name in ("often", "daily"):
        assert cluster.ended(name).state == "cancelled"
