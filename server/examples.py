"""Six recordings to learn on: simulated boards with a secret each, made when they are asked for.

Their boards can be put on any simulated rig: what a student measures there comes from the same gyro.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from calib_core.excitation import Excitation
from calib_core.problem import Problem

if TYPE_CHECKING:
    from calib_core.model import Model
    from calib_core.recording import Recording
    from server.store import Store

SLOW = Excitation("x", "sine", 39.8, (30.0,), (0.2513,))
STAIRS = Excitation("x", "staircase", 60.0, rates_dps=(20.0, 45.0, 70.0, 100.0))
QUICK = Excitation("x", "multisine", 20.0, (3.0, 1.5, 0.8), (1.0137, 2.0171, 4.0313))
POSES = Excitation("x", "poses", 45.0, angles_deg=(-90.0, -45.0, 45.0, 90.0, 60.0, -60.0, 0.0))


@dataclass(frozen=True)
class Example:
    """A board, what is wrong with it, and the motion that it was recorded with; ``effects`` as in a rig's address."""

    name: str
    seed: int
    effects: str
    motion: tuple[Excitation, ...]
    axis: str = "x"
    covariates: bool = False

    @property
    def board(self) -> str:
        return f"EXAMPLE-{self.seed}"

    def truth(self) -> "dict[str, Model]":
        from calib_core.twin import board_truth
        from calib_core.twin_effects import parse, with_effects

        return with_effects(board_truth(self.seed, self.board), parse(self.effects))


EXAMPLES = {
    example.name: example
    for example in (
        Example("healthy", 11, "", (SLOW, STAIRS, POSES, QUICK)),
        Example("poses", 12, "g_sensitivity.k_s:1.2e-3;g_sensitivity.k_c:-0.5e-3", (POSES, SLOW, STAIRS)),
        Example(
            "warm_air", 13, "bias_temperature.k1:3e-4",
            (Excitation("x", "hold", 15.0), Excitation("x", "heat", 40.0), SLOW, Excitation("x", "hold", 15.0), STAIRS),
            covariates=True,
        ),
        Example("full_scale", 14, "scale_factor_cubic.k:-3e-6", (SLOW, STAIRS, QUICK)),
        Example("reversals", 15, "hysteresis.h:1.2e-3", (SLOW, STAIRS, POSES)),
        Example("one_sine", 16, "bandwidth_lag.tau:0.005", (Excitation("x", "sine", 79.6, (30.0,), (0.2513,)),)),
    )
}  # fmt: skip


THESIS = {"thesis_rate": "rate", "thesis_position": "position"}
"""The thesis' own readings, as they are printed."""


def by_board(board: str) -> Example | None:
    return next((example for example in EXAMPLES.values() if example.board == board), None)


def record(example: Example) -> "Recording":
    """The example as the instrument would have recorded it; the same each time."""
    from calib_core.excitation import plan_of
    from server import engine
    from server.devices import open_rig

    rig = open_rig(f"twin:?seed={example.seed}&covariates={int(example.covariates)}&effects={example.effects}")
    rig.open()
    try:
        plan = plan_of(example.motion, experiment=example.name, axis=example.axis, seed=example.seed)
        return engine.record(plan, rig, board=example.board)
    finally:
        rig.close()


def kept(store: "Store", name: str) -> str | None:
    """The stored recording of an example, where it was made before."""
    if name not in (*EXAMPLES, *THESIS):
        raise Problem("example.not_found", given=name, allowed=", ".join((*EXAMPLES, *THESIS)))
    found, _ = store.recordings.find(q=name, limit=200)
    return next((str(row["id"]) for row in found if row["source"] == "example" and row["name"] == name), None)


def made(store: "Store", name: str) -> str:
    """The stored recording of an example, made now if it was not before."""
    there = kept(store, name)
    if there is not None:
        return there
    if name in THESIS:
        from calib_core.thesis.printed import every_reading

        return store.recordings.add_points(every_reading(THESIS[name]), board="", name=name, source="example")
    example = EXAMPLES[name]
    store.boards.ensure(example.board)
    return store.recordings.add(record(example), board=example.board, name=name, source="example")
