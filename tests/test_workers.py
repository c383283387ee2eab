"""Worker processes leave Ctrl-C to the process that started them."""

import os
import signal
import subprocess
import sys
import time

import pytest

SCRIPT = """
import sys, time
from joblib import delayed
from mampc.base.workers import in_parallel

def work(k):
    print("at work", flush=True)
    time.sleep(60)

try:
    print("ready", flush=True)
    list(in_parallel((delayed(work)(k) for k in range(4)), 2, ordered=bool(int(sys.argv[1]))))
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals of a process group")
@pytest.mark.parametrize("wait", [0.2, 0.8, 1.5, None])
def test_an_interruption_ends_them_at_once_and_without_a_traceback(tmp_path, wait):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    process = subprocess.Popen(
        [sys.executable, script, "1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    if wait is None:
        assert process.stdout.readline() == "at work\n"
    else:  # while they start
        time.sleep(wait)
    os.killpg(process.pid, signal.SIGINT)
    out, errors = process.communicate(timeout=50)
    assert out.splitlines()[-1] == "interrupted"
    assert "Traceback" not in errors  # loky may warn of what it cleans up
    assert process.returncode == 0
