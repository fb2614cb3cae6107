"""The command line before any command: what it offers, how it refuses, in which words."""

import subprocess
import sys
from pathlib import Path

import pytest
from shared import ROOT

from server import cli
from server.texts import LANGUAGES, texts

NAMES = cli.command_names()


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    code = cli.main(words)
    said = capsys.readouterr()
    return code, said.out, said.err


def test_without_arguments_it_says_what_it_can_do(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys)
    assert (code, err) == (0, "")
    for name in NAMES:
        assert f"  {name} " in out
    assert "gyrobench serve" in out


@pytest.mark.parametrize("name", NAMES)
def test_every_command_has_help_with_an_example_and_a_summary_in_both_languages(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main([name, "--help"])
    assert left.value.code == 0
    out = capsys.readouterr().out
    assert f"example:\n  gyrobench {name} " in out
    for lang in LANGUAGES:
        assert texts(lang)[f"command.{name}"]


@pytest.mark.parametrize("name", NAMES)
def test_the_example_in_the_help_is_understood_by_its_command(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    import shlex

    module = cli._module(name)
    parser = cli.Parser(prog=name)
    module.add(parser)
    for line in module.EXAMPLE.splitlines():
        parser.parse_args(shlex.split(line)[2:])
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("words", "en", "th"),
    [
        (["calibrate"], "--board is missing", "ยังไม่ได้ระบุ --board"),
        (["calibrate", "--board", "B", "--readings", "many"], '--readings does not take "many"', "รับค่า"),
        (["calibrate", "--board"], "--board needs a value", "--board"),
        (["calibrate", "--board", "B", "--color", "red"], "--color red is not understood", "ไม่รู้จัก --color red"),
        (["frobnicate"], "There is no command frobnicate", "ไม่มีคำสั่ง frobnicate"),
        (["--frobnicate"], "--frobnicate is not understood", "ไม่รู้จัก"),
    ],
)
def test_bad_use_is_one_sentence_on_stderr_and_exit_code_2(
    words: list[str], en: str, th: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for lang, expected in (("en", en), ("th", th)):
        code, out, err = run(capsys, "--lang", lang, *words)
        assert (code, out) == (2, "")
        assert expected in err
        assert err.count("\n") == 1


def test_the_language_may_stand_before_or_after_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert "ไม่รู้จัก" in run(capsys, "calibrate", "--board", "B", "--nope", "--lang=th")[2]


def test_a_file_that_is_not_there_is_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["verify", str(tmp_path / "none.json"), "--data", str(tmp_path)]
    code, _, err = run(capsys, *words)
    assert code == 2
    assert "none.json: No such file" in err


def test_a_fault_inside_is_a_sentence_too_and_not_a_traceback(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli, "command_names", lambda: 1 / 0)
    code, _, err = run(capsys, "verify", "x", "--data", str(tmp_path))
    assert code == 1
    assert "ZeroDivisionError" in err
    assert "Traceback" not in err


def test_only_the_chosen_command_is_imported() -> None:
    script = (
        "import sys; from server import cli; cli.main([]); "
        "print([m for m in ('numpy', 'fastapi', 'typst', 'scipy') if m in sys.modules], file=sys.stderr)"
    )
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=True)
    assert found.stderr.strip() == "[]"
