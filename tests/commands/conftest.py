"""Commands that are killed while they run."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from types import ModuleType
from typing import Any

import pytest

KILLED_WHILE_WRITING = """
import os, signal, {module} as module
write_json, written = module.write_json, []
def dying(path, data):
    written.append(path)
    if len(written) == {number}:
        path.with_name(f".{{path.name}}.{{os.getpid()}}.tmp").write_text("half")
        os.kill(os.getpid(), signal.SIGKILL)
    write_json(path, data)
module.write_json = dying
"""


@pytest.fixture
def run_until_killed() -> Callable[..., None]:
    """Returns a function that runs a command in a process, and a process group, of its own until it is killed.

    It is killed with its workers once `until()` is true; or else it kills itself, half-way through the file that the
    given module writes as its so many-th (`writing=(module, number)`), or through what runs first (`before`).
    """

    def run(
        command: Callable[..., None],
        *,
        until: Callable[[], object] | None = None,
        writing: tuple[ModuleType, int] | None = None,
        before: str = "",
        **arguments: Any,
    ) -> None:
        if writing is not None:
            before = KILLED_WHILE_WRITING.format(module=writing[0].__name__, number=writing[1])
        name = command.__name__
        imports = f"from pathlib import PosixPath\nfrom {command.__module__} import {name}"
        script = f"{imports}\n{before}\n{name}(**{arguments!r})"
        process = subprocess.Popen([sys.executable, "-c", script], start_new_session=True)
        try:
            if until is None:
                assert process.wait(timeout=300) == -signal.SIGKILL
                return
            deadline = time.monotonic() + 300
            while process.poll() is None and not until() and time.monotonic() < deadline:
                time.sleep(0.005)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    return run
