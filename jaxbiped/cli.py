"""The console command `jaxbiped`: every command says in a few lines what it did; bad input is exit code 2."""

import contextlib
import io
import json
import re
import sys
from typing import Any

import tyro

from jaxbiped.batch import workers
from jaxbiped.commands import (
    InputError,
    WorkersLost,
    demo,
    doctor,
    export,
    obstacles,
    payload,
    replay,
    report_page,
    tune,
    walk,
)

OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
Command = (
    demo.Demo
    | walk.Walk
    | payload.Payload
    | obstacles.Obstacles
    | tune.Tune
    | replay.Replay
    | report_page.Report
    | doctor.Doctor
    | export.Export
)


def main(args: list[str] | None = None) -> int:
    """Run the console command; returns the exit code: 0 done, 1 something is missing, 2 bad input."""
    try:
        command = _parse(args)
        workers.use_threads(workers.cores() if isinstance(command, tune.Tune) else 1)
        workers.keep_compiled_kernels()
        result = _run(command)
    except InputError as error:
        return _complain(error, BAD_INPUT)
    except (ImportError, WorkersLost) as error:
        return _complain(error, FAILED)
    except KeyboardInterrupt:
        return _complain(InputError("stopped; the same command goes on with what is finished"), INTERRUPTED)
    except SystemExit as stop:  # --help
        return int(stop.code or OK)
    if command.json:
        print(json.dumps(result))
    return OK


def _run(command: Command) -> dict[str, Any]:
    match command:
        case demo.Demo():
            return demo.run(command)
        case walk.Walk():
            return walk.run(command)
        case payload.Payload():
            return payload.run(command)
        case obstacles.Obstacles():
            return obstacles.run(command)
        case tune.Tune():
            return tune.run(command)
        case replay.Replay():
            return replay.run(command)
        case report_page.Report():
            return report_page.run(command)
        case doctor.Doctor():
            return doctor.run(command)
        case export.Export():
            return export.run(command)


def _complain(error: Exception, code: int) -> int:
    print("jaxbiped:", " ".join(str(error).split()), file=sys.stderr)
    return code


def _parse(args: list[str] | None) -> Command:
    """Read the arguments; tyro's box of complaints becomes one line."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(Command, prog="jaxbiped", args=args, description=__doc__)
    except SystemExit as stop:
        if stop.code in (OK, None):
            raise
        raise InputError(_one_line(complaint.getvalue())) from None


def _one_line(box: str) -> str:
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line).strip(" ─╭╮╰╯│") for line in box.splitlines()]
    return "; ".join(line for line in lines if line)


if __name__ == "__main__":
    sys.exit(main())
