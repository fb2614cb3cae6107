"""`gyrobench`: finds the command among server/commands and says what goes wrong in one sentence.

A command is one module: `add(parser)` declares its options, `main(args) -> int` does the work, `EXAMPLE` is the line
shown by `--help`. Only the chosen one is imported, so `gyrobench --help` never waits for numpy.
"""

import argparse
import importlib
import os
import pkgutil
import re
import sys
import traceback
from collections.abc import Sequence
from types import ModuleType
from typing import NoReturn

from calib_core.problem import Problem
from server import __version__
from server import commands as rooms
from server.texts import LANGUAGES, render, sentence

FIRST = (
    "serve",
    "calibrate",
    "diagnose",
    "certify",
    "verify",
    "thesis",
    "effects",
    "models",
    "import",
    "export",
    "bench",
)
BAD_USE, FAILED, INTERRUPTED = 2, 1, 130

# argparse's own sentences, in its words, and the texts that replace them.
_USAGE = (
    (r"the following arguments are required: (?P<name>.+)", "cli.required"),
    (r"argument (?P<name>[^:]+): invalid choice: '?(?P<given>.*?)'? \(choose from (?P<allowed>.+)\)", "cli.choice"),
    (r"argument (?P<name>[^:]+): invalid \w+ value: '(?P<given>.*)'", "cli.value"),
    (r"argument (?P<name>[^:]+): expected .*", "cli.expected"),
    (r"unrecognized arguments: (?P<given>.+)", "cli.unrecognized"),
)


class Parser(argparse.ArgumentParser):
    """Raises bad use as a Problem, so that it is told like every other refusal."""

    def error(self, message: str) -> NoReturn:
        for pattern, code in _USAGE:
            if match := re.fullmatch(pattern, message, re.DOTALL):
                raise Problem(code, command=self.prog, **match.groupdict())
        raise Problem("cli.usage", command=self.prog, detail=message)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code of CONTRACT 2."""
    words = list(sys.argv[1:] if argv is None else argv)
    # The small matrices of this work are slower with two threads; numpy reads this when it is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    lang = _language(words)
    try:
        code = _run(words, lang)
        sys.stdout.flush()
        return code
    except Problem as problem:
        return _say(problem, lang)
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output (head, a pager) left; nothing to tell it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except OSError as error:
        return _say(os_problem(error), lang)
    except Exception as error:
        if os.environ.get("GYROBENCH_TRACEBACK"):
            traceback.print_exc()
        return _say(Problem("internal", kind=type(error).__name__, detail=str(error)), lang, FAILED)


def os_problem(error: OSError) -> Problem:
    """A file or disk error as a Problem; the reason is the system's own word for it."""
    return Problem("file", path=str(error.filename or ""), reason=error.strerror or str(error))


def command_names() -> list[str]:
    """Every command there is, the everyday ones first. (`import` is a Python word, so its module is `import_`.)"""
    names = [module.name.removesuffix("_") for module in pkgutil.iter_modules(rooms.__path__)]
    return sorted(names, key=lambda name: (FIRST.index(name) if name in FIRST else len(FIRST), name))


def data_option(parser: argparse.ArgumentParser) -> None:
    """`--data`, the same for every command that reads or writes the store."""
    parser.add_argument(
        "--data",
        metavar="DIR",
        help="the database's directory (else GYROBENCH_DATA, else the platform's user data directory)",
    )


def _run(words: list[str], lang: str) -> int:
    top = Parser(prog="gyrobench", add_help=False, allow_abbrev=False)
    top.add_argument("-h", "--help", action="store_true")
    top.add_argument("--version", action="store_true")
    top.add_argument("--lang", choices=LANGUAGES)
    top.add_argument("command", nargs="?")
    # The command's own options are its parser's business: hand over everything from its name on.
    at = next((i for i, word in enumerate(words) if not _is_option(words, i)), len(words))
    options = top.parse_args(words[: at + 1])
    if options.version:
        print(f"gyrobench {__version__}")
        return 0
    names = command_names()
    if options.command is None:
        print(_overview(names, lang))
        return 0
    if options.command not in names:
        raise Problem("cli.command", given=options.command, allowed=", ".join(names))
    module = _module(options.command)
    parser = Parser(
        prog=f"gyrobench {options.command}",
        description=render(f"command.{options.command}", {}, lang),
        epilog=f"{render('cli.example', {}, lang)}\n  {module.EXAMPLE}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    module.add(parser)
    parser.add_argument("--lang", choices=LANGUAGES, default=lang, help="language of sentences (default en)")
    exit_code: int = module.main(parser.parse_args(words[at + 1 :]))
    return exit_code


def _is_option(words: list[str], i: int) -> bool:
    return words[i].startswith("-") or (i > 0 and words[i - 1] == "--lang")


def _module(name: str) -> ModuleType:
    present = {module.name.removesuffix("_"): module.name for module in pkgutil.iter_modules(rooms.__path__)}
    return importlib.import_module(f"server.commands.{present[name]}")


def _overview(names: list[str], lang: str) -> str:
    width = max(map(len, names), default=0)
    lines = [render("cli.purpose", {}, lang), "", render("cli.commands", {}, lang)]
    lines += [f"  {name:<{width}}  {render(f'command.{name}', {}, lang)}" for name in names]
    return "\n".join([*lines, "", render("cli.more", {}, lang)])


def _language(words: list[str]) -> str:
    """Known before parsing, because what goes wrong in parsing is told in it too."""
    for i, word in enumerate(words):
        given = word.removeprefix("--lang=") if word != "--lang" else "".join(words[i + 1 : i + 2])
        if word.startswith("--lang") and given in LANGUAGES:
            return given
    return "en"


def _say(problem: Problem, lang: str, code: int = BAD_USE) -> int:
    from server.devices import DeviceError

    print(sentence(problem, lang), file=sys.stderr)
    return FAILED if isinstance(problem, DeviceError) else code


if __name__ == "__main__":
    sys.exit(main())
