"""The console command `jaxbiped`: every command says in a few lines what it did; bad input is exit code 2."""

import contextlib
import dataclasses
import functools
import io
import json
import operator
import os
import re
import sys
from collections.abc import Callable
from importlib import metadata
from typing import Any

import tyro

from jaxbiped import runtime
from jaxbiped.checked import Refusal, nearest, one_line
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
    run,
    tune,
    walk,
)
from jaxbiped.commands.common import plain

OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
COMMANDS: dict[str, tuple[type[Any], Callable[[Any], dict[str, Any]]]] = {
    "demo": (demo.Demo, demo.run),
    "walk": (walk.Walk, walk.run),
    "payload": (payload.Payload, payload.run),
    "obstacles": (obstacles.Obstacles, obstacles.run),
    "run": (run.Run, run.run),
    "tune": (tune.Tune, tune.run),
    "replay": (replay.Replay, replay.run),
    "report": (report_page.Report, report_page.run),
    "doctor": (doctor.Doctor, doctor.run),
    "export": (export.Export, export.run),
}
"""The record of a command's arguments, and what carries it out."""
_HELP = ("-h", "--help")
_PLACES = {"replay": ("--table", "--row"), "report": ("--table",), "run": ("--file",)}
"""Arguments that are known by their place, not by their name."""
_REPEATED = ("--obstacle", "--payload", "--variant")
"""Arguments of `walk` that may be given several times."""
_RENAMED = {"--arm": "--variant"}
"""Old names of arguments, and their new ones."""
_TITLES = ("Missing argument", "Value error", "Required options", "Unrecognized options")
"""Titles of tyro's boxes of complaints."""
_WORDS = {"INT": "a whole number", "FLOAT": "a number", "PATH": "a path", "STR": "a text"}


def main(args: list[str] | None = None) -> int:
    """Run the console command; returns the exit code: 0 done, 1 something is missing, 2 bad input."""
    args = sys.argv[1:] if args is None else list(args)
    with contextlib.suppress(AttributeError):  # signs that the terminal does not know become question marks
        sys.stdout.reconfigure(errors="replace")  # type: ignore[union-attr]
    if args == ["--version"]:
        print(f"jaxbiped {metadata.version('jaxbiped')}")
        return OK
    try:
        name, command = _parse(args)
        runtime.use_threads(runtime.cores() if name == "tune" else 1)
        runtime.keep_compiled_kernels()
        result = COMMANDS[name][1](command)
        if command.json:
            print(json.dumps(plain(result)))
        sys.stdout.flush()
    except (InputError, Refusal) as error:
        return _complain(error, BAD_INPUT)
    except (ImportError, WorkersLost) as error:
        return _complain(error, FAILED)
    except KeyboardInterrupt:
        return _complain(InputError("stopped; the same command goes on with what is finished"), INTERRUPTED)
    except SystemExit as stop:  # --help
        return int(stop.code or OK)
    except OSError as error:  # the output cannot be written, or whoever read it has gone
        if not isinstance(error, BrokenPipeError):
            _complain(InputError(f"{error.filename or 'output'}: {error.strerror or error}"), FAILED)
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
        return FAILED
    return OK


def _complain(error: Exception, code: int) -> int:
    print("jaxbiped:", one_line(" ".join(str(error).split())), file=sys.stderr)
    return code


def _parse(args: list[str]) -> tuple[str, Any]:
    """The name of the command and its arguments; complaints are one line, with the nearest known name."""
    if args and args[0] in _HELP:
        every = functools.reduce(operator.or_, (record for record, _ in COMMANDS.values()))
        tyro.cli(every, prog="jaxbiped", args=["--help"], description=__doc__)
    names = ", ".join(COMMANDS)
    if not args:
        raise InputError(f"command: got none, allowed: {names}, or --help, --version")
    name, *rest = args
    if name not in COMMANDS:
        known = (*COMMANDS, "--help", "--version")
        raise InputError(
            f"command: got '{name}', allowed: {names}, or --help, --version{nearest(name.lower(), known)}"
        )
    record = COMMANDS[name][0]
    _refuse_unknown(name, record, rest)
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return name, tyro.cli(record, prog=f"jaxbiped {name}", args=rest)
    except SystemExit as stop:
        if stop.code in (OK, None):
            raise
        raise InputError(_in_one_line(name, complaint.getvalue())) from None


def _refuse_unknown(name: str, record: type[Any], args: list[str]) -> None:
    """Refuse an argument that the command does not have, before anything else is looked at."""
    known = [f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(record)]
    known = [option for option in known if option not in _PLACES.get(name, ())]
    switched, given = [f"--no-{option[2:]}" for option in known], set()
    for word in args:
        if not word or (word.endswith("=") and word.startswith("--")):
            raise InputError(f"{name}: got an empty argument ({word or chr(39) * 2}), allowed: a value")
        option = word.partition("=")[0].replace("_", "-")
        if option in _RENAMED and option not in known:
            raise InputError(f"{option}: got the old name of an argument, allowed: {_RENAMED[option]}")
        if option.startswith("--") and option not in (*known, *switched, *_HELP):
            raise InputError(
                f"{option}: got an argument that '{name}' does not have, allowed: {', '.join(known)}"
                f"{nearest(option.lower(), known)}"
            )
        if option in given and not (name == "walk" and option in _REPEATED):
            raise InputError(f"{option}: got it twice, allowed: once, with all its values")
        given.update([option] if option.startswith("--") else [])


def _in_one_line(name: str, box: str) -> str:
    """Put what tyro says in a box into the words of the other refusals."""
    said, told = _parts(re.sub(r"\x1b\[[0-9;]*m", "", box))
    if match := re.match(r"Missing from .*?: (.*)", said):
        option, *words = match[1].removesuffix(" (required)").split()
        text = " ".join(words[1:] if words and words[0].isupper() else words)
        return f"{option}: missing, required by '{name}': {text}"
    if match := re.match(r"Missing value for argument '(.*?)'", said):
        return f"{match[1]}: got no value, allowed: one or more; see jaxbiped {name} --help"
    if match := re.match(r"Error parsing (\S+): (.*)", said):
        got = re.search(r"'[^']*'", match[2])
        kind = next((re.sub(r"^\S+ ?", "", line) for line in told if line.startswith(match[1])), "")
        kind = kind or ("INT" if "int()" in match[2] else "FLOAT" if "float" in match[2] else "")
        words = next((text for word, text in _WORDS.items() if word in kind), kind or "see --help")
        return f"{match[1]}: got {got[0] if got else match[2]}, allowed: {words}"
    if match := re.match(r"Unrecognized options: (.*)", said):
        return f"{name}: got '{match[1]}' beyond its arguments, allowed: what jaxbiped {name} --help lists"
    return said


def _parts(box: str) -> tuple[str, list[str]]:
    """The complaint in a box of tyro's, and the lines of help below it; boxes differ with the terminal."""
    parts: list[list[str]] = [[]]
    for line in (line.strip(" │|") for line in box.splitlines()):
        if re.fullmatch(r"[╭╰+].*[╮╯+]", line) or line in _TITLES:
            continue
        if line and set(line) <= set("─-"):
            parts.append([])
        elif line:
            parts[-1].append(line)
    said, *told = [part for part in parts if part] or [[]]
    return " ".join(said), told[0] if told else []


if __name__ == "__main__":
    sys.exit(main())
