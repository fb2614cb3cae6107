"""What an effect is: parameters, a place in the signal chain, and columns that follow from covariates."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


class Stage(Enum):
    """Where in the signal chain an effect acts, in this order."""

    TABLE = "table"
    SENSOR = "sensor"
    ELECTRICS = "electrics"
    ACQUISITION = "acquisition"


class Acts(Enum):
    """What an effect's columns are derivatives of."""

    ANGLE = "angle"  # what the encoder tells, deg
    RATE = "rate"  # what the sensor feels, deg/s; the scale factor multiplies it
    OUTPUT = "output"  # what the gyro puts out, in the recording's unit


@dataclass(frozen=True)
class Param:
    """A parameter; one with a ``grid`` is nonlinear and is searched there, then refined within ``bounds``."""

    unit: str
    """``{out}`` stands for the recording's unit."""
    typical: float
    bounds: tuple[float, float]
    grid: tuple[float, ...] = ()
    log: bool = False
    discrete: bool = False
    """Whether only the values of the grid have a meaning (how many terms of a series)."""
    code: str = ""
    """What ``columns`` gives for a linear parameter, as a formula for exported compensation: over covariates,
    ``warmth``, ``reference_supply_v``, ``<a>_acceleration_g``, the nonlinear parameters, and ``lagged(value, tau)``."""


@dataclass
class Covariates:
    """What is known at n instants. In the twin it is the truth; from a recording, the best estimate of it.

    ``memory`` lets effects that remember go on from block to block; a fresh one starts settled.
    """

    axis: str
    time_s: F64
    rate_dps: F64
    position_deg: F64
    acceleration_dps2: F64
    direction: F64
    """Sign of the last rotation; 0 before the first."""
    interval_s: float
    temperature_c: F64 | None = None
    supply_v: F64 | None = None
    other_rate_dps: F64 | None = None
    tilt_deg: F64 | None = None
    """The x axis' angle: it turns gravity in the sensor."""
    specific_force_g: Mapping[str, F64] | None = None
    reference: Mapping[str, float] = field(default_factory=dict)
    """Where temperature and supply count from (``temperature_c``, ``supply_v``)."""
    memory: dict[str, F64] = field(default_factory=dict)

    @property
    def warmth(self) -> F64:
        """T - T₀, °C."""
        assert self.temperature_c is not None
        return self.temperature_c - self.reference["temperature_c"]

    def lagged(self, values: F64, tau_s: float, key: str) -> F64:
        """First-order lag with time constant ``tau_s``; starts settled on the first value."""
        from scipy.signal import lfilter

        pole = np.exp(-self.interval_s / tau_s)
        # Between samples the input is taken as the mean of the two: a step held for one sample would lag by half of it.
        gain = (1.0 - pole) / 2.0
        state = self.memory.get(key, np.array([(1.0 - gain) * values[0]]))
        out, self.memory[key] = lfilter([gain, gain], [1.0, -pole], values, zi=state)
        return np.asarray(out)


@dataclass
class Chain:
    """A block of the signal on its way: an effect as truth changes one of these in place."""

    covariates: Covariates
    encoder_deg: F64
    rate_dps: F64
    output: F64
    scale_factor: float
    rng: np.random.Generator


class Effect:
    """A physical effect. Subclasses say all about themselves in one file; see STYLE 6.

    An instance carries parameter values (``BiasTemperature(k1=2e-4)``) and serves as truth in the twin; the class
    serves as suspect in the diagnosis.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    acts: ClassVar[Acts]
    needs: ClassVar[tuple[str, ...]] = ()
    positive: ClassVar[bool] = False
    """Whether the linear parameter can only be positive."""
    curvature: ClassVar[float | None] = None
    """κ of a late answer: in terms of the measured rate w the loss is τ·w' + κ·τ²·w'' (METHOD 2)."""
    third: ClassVar[float] = 0.0
    """And that of the next order: what multiplies τ³."""
    about: ClassVar[bool] = False
    """Whether the one linear parameter is refined by columns about its value: to first order is not enough."""

    def __init__(self, **values: float) -> None:
        known = self.parameters()
        unknown = set(values) - set(known)
        if unknown:
            raise ValueError(f"{self.name}: no parameter {sorted(unknown)}; there are {sorted(known)}")
        # Of a series every term that is given counts.
        usual = {n: 0.0 if not p.grid else max(p.grid) if p.discrete else p.typical for n, p in known.items()}
        self.values = {name: float(values.get(name, value)) for name, value in usual.items()}

    @classmethod
    def parameters(cls) -> dict[str, Param]:
        """All parameters by name, in the order of the file."""
        return {name: p for name, p in vars(cls).items() if isinstance(p, Param)}

    @classmethod
    def linear(cls) -> tuple[str, ...]:
        return tuple(name for name, p in cls.parameters().items() if not p.grid)

    @classmethod
    def nonlinear(cls) -> tuple[str, ...]:
        return tuple(name for name, p in cls.parameters().items() if p.grid)

    @classmethod
    def card(cls) -> dict[str, str]:
        """The physics card: first line and ``Field: text`` lines of the docstring."""
        lines = inspect.cleandoc(cls.__doc__ or "").splitlines()
        card = {"summary": lines[0]}
        key = ""
        for line in lines[1:]:
            head, colon, rest = line.partition(":")
            if colon and not line.startswith(" "):
                key = head.lower().replace(" ", "_")
                card[key] = rest.strip()
            elif key and line.strip():
                card[key] += " " + line.strip()
        return card

    @classmethod
    def missing(cls, c: Covariates) -> bool:
        """Whether the recording lacks a covariate that the effect needs."""
        return any(getattr(c, need) is None for need in cls.needs)

    @classmethod
    def columns(cls, c: Covariates, **nonlinear: float) -> dict[str, F64]:  # noqa: ARG003
        """For each linear parameter the derivative (n,) of what the effect ``acts`` on.

        An effect whose only parameter is nonlinear gives its whole shape under the name "".
        An effect with no shape in the residual (a variance, a limit, a histogram) gives none.
        """
        return {}

    def apply(self, chain: Chain) -> None:
        """The effect as truth: lays itself on the block in ``chain``."""
        shapes = self.columns(chain.covariates, **{name: self.values[name] for name in self.nonlinear()})
        total = np.zeros_like(chain.rate_dps)
        for name, shape in shapes.items():
            total += self.values.get(name, 1.0) * shape
        if self.acts is Acts.ANGLE:
            chain.encoder_deg = chain.encoder_deg + total
        elif self.acts is Acts.RATE:
            chain.rate_dps = chain.rate_dps + total
        else:
            chain.output = chain.output + total
