"""`gyrobench bench`: what a row says, and the filters' figures themselves."""

import json

import pytest

from server import bench, cli
from server.bench import Row, boards, startup, table


def test_a_figure_is_judged_on_its_own_side_of_the_limit() -> None:
    assert Row("speed", 800, "×", 400, at_least=True).ok
    assert not Row("speed", 399, "×", 400, at_least=True).ok
    assert Row("error", 0.01, "%", 0.02).ok
    assert not Row("error", 0.03, "%", 0.02).ok
    assert Row("shown as it is", 99.0, "%").ok


def test_ratio_is_how_many_times_better_than_the_limit() -> None:
    assert Row("speed", 800, "×", 400, at_least=True).ratio == 2.0
    assert Row("error", 0.01, "%", 0.02).ratio == 2.0
    assert Row("exact", 0.0, "V", 1e-9).ratio is None


def test_table_says_which_limit_was_missed_and_against_what() -> None:
    lines = table([Row("a", 3.0, "×", 8, at_least=True, ours="1 ns", theirs="3 ns"), Row("longer", 1.0, "%")])
    first, second = lines.splitlines()
    assert first.split() == ["a", "3", "×", "≥", "8", "MISSED", "1", "ns", "against", "3", "ns"]
    assert second.split() == ["longer", "1", "%"]


def test_an_unknown_benchmark_is_refused_with_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "nothing"]) == 2
    assert "core" in capsys.readouterr().err


def test_filters_reach_their_figures(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(bench, "SUBJECTS", {"core": ("core",)})
    assert cli.main(["bench", "core", "--quick", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["core"]}
    assert len(rows) >= 9
    assert not {name: row for name, row in rows.items() if not row["ok"]}


def test_start_up_is_measured_in_a_fresh_interpreter() -> None:
    assert startup._cpu("pass" + startup.REPORT) < startup._cpu(startup.IMPORTS + startup.REPORT)


def test_a_simulated_board_is_found_again_by_both_estimates() -> None:
    for found in boards.board(3):
        for scale_pct, bias_mV in found.values():
            assert abs(scale_pct) < 0.1
            assert abs(bias_mV) < 0.1


def test_the_soak_belongs_to_the_bus(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "core", "--soak"]) == 2
    assert "bench bus --soak" in capsys.readouterr().err
