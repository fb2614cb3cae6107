"""The hidden bench of a blind exercise: a twin whose truth only the server knows, and the runs that students do on it.

What a run gives says how it was moved and what was measured, and nothing of the truth: no rig address, no seed, no
effect in its header, and no failure that would tell of one.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib_core import excitation, experiment, sequence, strengths
from calib_core.effects import library
from calib_core.excitation import Excitation
from calib_core.gyro_models import PRESETS
from calib_core.model import Model, Noise
from calib_core.problem import Problem
from calib_core.sequence import Axis
from calib_core.twin import LATCH_S, Plant, board_truth
from calib_core.twin_daq import DaqSpec
from calib_core.twin_servo import RX28, RX64, STEP_DEG
from server.devices.rig import Rig
from server.devices.twin_rig import TwinDaq, TwinTable

if TYPE_CHECKING:
    from calib_core.recording import Recording

GYRO = PRESETS["LPY503AL-OUT"]
AXES: Mapping[str, Axis] = {
    axis: Axis(axis, -150.0, 150.0, part.top_rate_dps, STEP_DEG, part.part, part.supply_V)
    for axis, part in (("x", RX28), ("z", RX64))
}
LONGEST_S = 900.0
BETWEEN_S = 60.0
"""Bench time between two runs of a student: what was warmed cools, drifts go on."""
PREVIEW_POINTS, PREVIEW_HZ = 3000, 25.0
Motion = Sequence[Mapping[str, Any]]


def truth(
    axis: str,
    seed: int,
    *,
    difficulty: str | None = None,
    effects: Sequence[Mapping[str, Any]] = (),
    noise: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """What is hidden: a board drawn from the seed, and effects as chosen, or drawn where a ``difficulty`` is given.

    An effect is ``{"effect", "strength"}`` or ``{"effect", "parameters"}``. Raises Problem where one cannot be hidden.
    """
    rng = np.random.default_rng(_seed("truth", seed))
    board = board_truth(_seed("board", seed))[axis]
    if difficulty is not None:
        effects = [{"effect": name, "strength": s} for name, s in strengths.surprise(difficulty, rng).items()]
    hidden: dict[str, dict[str, Any]] = {}
    for one in effects:
        name, strength = one["effect"], one.get("strength")
        if name in hidden:
            raise Problem("lab.twice", effect=name)
        if one.get("parameters"):
            strength, values = None, strengths.checked(name, one["parameters"])
        else:
            strength = 1.0 if strength is None else strength
            values = strengths.parameters(name, strength, rng, bias=board.bias, scale_factor=board.scale_factor)
        hidden[name] = {"effect": name, "strength": strength, "parameters": values}
    return {
        "axis": axis,
        "seed": seed,
        "effects": list(hidden.values()),
        "difficulty": difficulty,
        "noise": dict(noise or {}),
        "bias_V": board.bias,
        "scale_factor_V_per_dps": board.scale_factor,
    }


def bench(hidden: Mapping[str, Any], code: str, student: str, run: int) -> Rig:
    """The rig of one run: always the same board, servos and clock; noise of its own."""
    rng = np.random.default_rng(_seed("parts", hidden["seed"]))
    servos = {a: replace(part, speed_error=rng.normal(0.0, 0.005)) for a, part in (("x", RX28), ("z", RX64))}
    daq = DaqSpec(clock_error=rng.uniform(-5e-5, 5e-5))
    models = {a: _noisy(model, hidden["noise"]) for a, model in board_truth(_seed("board", hidden["seed"])).items()}
    effects = [library()[one["effect"]](**one["parameters"]) for one in hidden["effects"]]
    models[hidden["axis"]] = replace(models[hidden["axis"]], effects=tuple(effects))
    plant = Plant(_seed("run", hidden["seed"], student, run), models, servos=servos, daq=daq, covariates=True)
    table = TwinTable(plant)
    one_way_s = daq.transfer_s + LATCH_S
    return Rig(
        f"lab:{code}", table, TwinDaq(table), simulated=True, heat=table.heat, later=table.later, one_way_s=one_way_s
    )


def _noisy(model: Model, noise: Mapping[str, float]) -> Model:
    white, ar1 = noise.get("white_mV", 1.2), noise.get("correlated_mV", 0.0)
    return replace(model, noise=Noise(1e-3 * white, 1e-3 * ar1, noise.get("correlation_time_s", 0.5)))


def _seed(*parts: object) -> int:
    """Seeds of one purpose tell nothing of those of another, and a seed on a rig's address makes another board."""
    return int.from_bytes(hashlib.sha256("/".join(map(str, ("blind bench", *parts))).encode()).digest()[:6], "big")


# --- motions -----------------------------------------------------------------------------------------------------
def offers(axis: str) -> dict[str, list[Excitation]]:
    """What is offered for an axis, by name, each inside this bench's limits."""
    top = round(excitation.NEAR_TOP * min(AXES[axis].max_rate_dps, GYRO.axes[axis].range_dps), 1)
    rates = tuple(round(top * part, 1) for part in (0.1, 0.25, 0.45, 0.65, 0.85, 1.0))
    other = "z" if axis == "x" else "x"
    angles = (-120.0, -60.0, 30.0, 90.0, 120.0, 60.0, -30.0, -90.0, 0.0)
    return {
        "sine": [Excitation(axis, "sine", 59.7, (30.0,), (0.2513,))],
        "multisine": [Excitation(axis, "multisine", 60.0, (5.0, 2.4, 1.2), (1.0137, 2.0171, 4.0313))],
        "staircase": [Excitation(axis, "staircase", 60.0, rates_dps=rates)],
        "slow": [Excitation(axis, "staircase", 60.0, rates_dps=(4.0, 9.0, 19.0))],
        "poses": [Excitation("x", "poses", 60.0, angles_deg=angles)],
        "hold": [Excitation(axis, "hold", 60.0)],
        "heat": [Excitation(axis, "heat", 60.0), Excitation(axis, "hold", 60.0)],
        "warm_rates": [Excitation(axis, "heat", 60.0), Excitation(axis, "staircase", 60.0, rates_dps=rates[2:])],
        "other": [Excitation(other, "sine", 60.0, (25.0,), (0.4019,))],
    }


STARTERS: Mapping[str, tuple[str, ...]] = {"sine": ("sine",), "mixed": ("sine", "staircase", "hold")}


def starter(name: str, axis: str) -> list[dict[str, Any]]:
    """The motion of the recording that a student begins with."""
    return [step.to_json() for offer in STARTERS[name] for step in offers(axis)[offer]]


def planned(motion: Motion, axis: str, name: str) -> sequence.Plan:
    """The plan of a run. Raises Problem where sensor or servos cannot do it, or where it takes too long."""
    plan = excitation.plan_of(
        [Excitation.from_json(one) for one in motion], experiment=name, axis=axis, gyro_model=GYRO
    )
    if plan.duration_s > LONGEST_S:
        raise Problem("lab.too_long", duration_s=plan.duration_s, longest_s=LONGEST_S)
    sequence.check(plan, AXES)
    return plan


def preview(motion: Motion, axis: str) -> dict[str, Any]:
    """How long a motion takes and where it sends the table: for a picture before it is run. Raises as `planned`."""
    plan = planned(motion, axis, "plan")
    steps = plan.states[0].steps
    rate_hz = min(PREVIEW_HZ, PREVIEW_POINTS / plan.duration_s)
    angles = excitation.commanded(steps, rate_hz)
    n = len(angles["x"])
    return {
        "duration_s": round(plan.duration_s, 1),
        "time_s": np.round(np.arange(n) / rate_hz, 3).tolist(),
        "angle_deg": {name: np.round(values, 2).tolist() for name, values in angles.items()},
        "warming_degC": np.round(excitation.warming(steps, rate_hz)[:n], 2).tolist(),
    }


# --- runs, in the compute process --------------------------------------------------------------------------------
def measured(
    hidden: Mapping[str, Any], code: str, student: str, run: int, motion: Motion, begin_s: float
) -> "Recording":
    """One run at full speed on the hidden bench, which has been on for ``begin_s``.

    Raises Problem where the motion cannot be done, before anything moves, and ``lab.bench_failed`` for anything else.
    """
    from server import engine

    plan = planned(motion, hidden["axis"], str(run))
    rig = bench(hidden, code, student, run)
    rig.open()
    rig.after(begin_s)
    # What goes wrong inside may name what is hidden there: neither the log nor the answer repeats it.
    engine.log.disabled = True
    try:
        return engine.record(plan, rig, board=f"LAB-{code}", header={"axis": hidden["axis"]})
    except Problem as problem:
        if problem.code == "internal":
            raise Problem("lab.bench_failed") from None
        raise
    finally:
        engine.log.disabled = False


def rehearse(hidden: Mapping[str, Any]) -> None:
    """Moves a bench once before its code is given out. Raises Problem where its truth makes it fail."""
    quick = [step.to_json() for name in ("multisine", "staircase", "heat") for step in offers(hidden["axis"])[name]]
    short = [one | {"duration_s": 6.0 if one["kind"] != "staircase" else 12.0} for one in quick]
    found = measured(hidden, "NEW", "rehearsal", 0, short, 0.0)
    volts = found.columns[f"{hidden['axis']}_gyro_v"]
    if not np.isfinite(volts).all() or math.isclose(float(volts.min()), float(volts.max())):
        raise Problem("lab.bench_failed")


def run(data: Path, code: str, student: str, motion: Motion, joins: str | None, restart: bool) -> str:
    """A student's run, kept as a recording – joined to an earlier one where asked; gives the recording's id."""
    from server.store import Store
    from server.store_recordings import LAB

    with Store(data) as store:
        hidden, known = store.lab.truth(code), store.lab.student(code, student)
        hand = None
        if joins is not None:
            hand = store.lab.own_run(student, joins)
            if restart or hand["session"] != known["session"]:
                raise Problem("lab.other_session")
        number = store.lab.next_run(student)
        begin_s = 0.0 if restart else known["bench_s"]
        made = measured(hidden, code, student, number, motion, begin_s)
        end_s = begin_s + float(made.time_s[-1])
        numbers, span_s = [number], begin_s
        if hand is not None:
            made = experiment.join(store.recording(joins or ""), made, hidden["axis"], begin_s - hand["end_s"])
            numbers, span_s = [*hand["numbers"], number], hand["begin_s"]
        name = f"LAB-{code} {'+'.join(map(str, numbers))}"
        with store.connection.write():
            kept = store.recordings.add(made, board=f"LAB-{code}", name=name, source=LAB)
            store.lab.keep_run(
                student, kept, numbers=numbers, motion=motion, begin_s=span_s, end_s=end_s,
                run_s=end_s - begin_s, restart=restart, pause_s=BETWEEN_S,
            )  # fmt: skip
        return kept


def judged(data: Path, code: str, student: str, recording: str) -> dict[str, Any]:
    """What the instrument says of a student's recording; a Problem as ``{"message"}``."""
    from server import diagnosis
    from server.store import Store

    with Store(data) as store:
        axis = store.lab.truth(code)["axis"]
        store.lab.own_run(student, recording)
        try:
            answer = diagnosis.of_recording(store.recording(recording), axis=axis)
        except Problem as problem:
            return {"message": {"code": problem.code, "values": diagnosis.plain(problem.values)}}
    return {
        name: answer[name] for name in ("verdict", "code", "values", "missing", "rivals", "rival_sets", "candidates")
    }
