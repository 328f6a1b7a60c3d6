"""Dump and restore of an ordinary user's processes, without a pid namespace."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.programs import path_of, require

#: Runs as the user: a counter goes through two images, and ends through its shim.
HOPS = """
import json, os, subprocess, sys, time
from pathlib import Path
from rosrm_criu.engine import dump, received, restore_result
from rosrm_criu.engine.binary import opened

program, folder = Path(sys.argv[1]), Path(sys.argv[2])
COUNTER = '''
import signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))
count = 0
while True:
    count += 1
    print(count, flush=True)
    time.sleep(0.01)
'''

def start(words, log):
    with log.open("wb") as output:
        return subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
        )

def grown(log):
    end = time.monotonic() + 60
    while log.read_text().count("\\n") < 3:
        if time.monotonic() > end:
            sys.exit(f"no numbers in {log}")
        time.sleep(0.01)

logs = [folder / f"{number}.log" for number in range(3)]
process = start([sys.executable, "-I", "-S", "-c", COUNTER], logs[0])
try:
    for log in logs[1:]:
        grown(logs[logs.index(log) - 1])
        image = folder / log.stem
        dump.dump(opened(program), process.pid, image, leave="killed", timeout=60)
        received.check(image, state=folder, working_directory=None, uid=os.geteuid())
        process.wait(60)
        words = restore_result.command(sys.executable, image, criu=program, remove=True, timeout=60)
        process = start(words, log)
        over = lambda: process.poll() is not None
        restored = restore_result.wait(image, timeout=60, ended=over)
    grown(logs[-1])
    process.terminate()
    code = process.wait(60)
finally:
    if process.poll() is None:
        process.terminate()
        process.wait(60)
print(json.dumps([code, restored.namespace, "".join(log.read_text() for log in logs).split()]))
"""


@pytest.mark.timeout(240)
def test_a_process_of_an_unprivileged_user_is_restored(criu, as_nobody, public):
    """CRIU with capabilities alone restores twice in a row, without a lost number or exit code."""
    program = public / "criu"
    shutil.copy(Path(criu.command[0]).resolve(), program)
    if program.read_bytes()[:4] != b"\x7fELF":
        pytest.skip(f"{criu.command[0]} is a script, which can be given no capabilities")
    able = "cap_checkpoint_restore,cap_setpcap+eip"
    require("setcap")
    if subprocess.run([path_of("setcap"), able, program], check=False).returncode != 0:
        pytest.skip("no capabilities on this file system")
    done = as_nobody("-c", HOPS, program, public, home=public)
    assert done.returncode == 0, done.stderr
    code, namespace, numbers = json.loads(done.stdout)
    assert (code, namespace) == (7, False)
    assert numbers == [str(number) for number in range(1, len(numbers) + 1)]
