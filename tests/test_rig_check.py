"""The rig's step check (thesis 4.1.3)."""

import pytest
from bench_recording import STEP, record

from calib_core import rig_check
from calib_core.problem import Problem


def test_a_slow_step_that_stops_short_shows_both_errors() -> None:
    found = rig_check.step(record([("step_x", 0.0, 119.4, 58.0, 0.2, 0.4)]), "x")
    assert found is not None
    assert found.rate_error_pct == pytest.approx(100 * 2 / 60, abs=0.2)
    assert found.position_error_pct == pytest.approx(100 * 0.6 / 120, abs=100 * STEP / 120)


def test_a_session_without_a_step_has_no_check() -> None:
    assert rig_check.step(record([("rest", 0.0, 0.0, 1.0, 1.0, 2.0)]), "x") is None


def test_a_table_that_does_not_turn_is_refused() -> None:
    with pytest.raises(Problem, match="no_step"):
        rig_check.step(record([("step_x", 0.0, 0.0, 60.0, 1.0, 2.0)]), "x")
