"""The command `avis`, run in a fork of the test's process: a new interpreter would import the package each time."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import traceback
from typing import BinaryIO, NoReturn

ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "COLUMNS": "100"}
STREAMS = (0, "r"), (1, "w"), (2, "w")
NEW_INTERPRETER = "import sys; sys.argv[0] = 'avis'\nfrom avis_ctrl.cli import main; main()"


def avis(
    *arguments: object,
    answers: str = "",
    env: dict[str, str] | None = None,
    timeout: float = 600.0,
    new_interpreter: bool = False,
) -> subprocess.CompletedProcess[str]:
    """Run `avis` with these arguments and answers at its standard input.

    new_interpreter : for commands that use clarabel or typst: their threads do not survive a fork.
    """
    words, variables = [str(one) for one in arguments], ENVIRONMENT | (env or {})
    if new_interpreter or sys.platform != "linux":  # elsewhere a fork of a process with threads is not safe
        return subprocess.run(
            [sys.executable, "-c", NEW_INTERPRETER, *words],
            input=answers,
            capture_output=True,
            text=True,
            check=False,
            timeout=timeout,
            env=os.environ | variables,
        )
    with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        given.write(answers.encode())
        given.seek(0)
        child = os.fork()
        if child == 0:
            _run(words, variables, (given, output, errors))
        clock = threading.Timer(timeout, os.kill, (child, 9))
        clock.start()
        _, status = os.waitpid(child, 0)
        clock.cancel()
        texts = []
        for file in (output, errors):
            file.seek(0)
            texts.append(file.read().decode())
    return subprocess.CompletedProcess(["avis", *words], os.waitstatus_to_exitcode(status), *texts)


def _run(words: list[str], variables: dict[str, str], files: tuple[BinaryIO, ...]) -> NoReturn:
    """The child's part: as a new process with these arguments, files and variables."""
    code: object = 0
    try:
        for number, file in enumerate(files):
            os.dup2(file.fileno(), number)
        sys.stdin, sys.stdout, sys.stderr = (os.fdopen(os.dup(k), mode, encoding="utf-8") for k, mode in STREAMS)
        os.environ.update(variables)
        sys.argv = ["avis", *words]
        from avis_ctrl.cli import main

        main()
    except SystemExit as end:
        code = end.code
    except BaseException:
        traceback.print_exc()
        code = 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code if isinstance(code, int) else 0 if code is None else 1)
