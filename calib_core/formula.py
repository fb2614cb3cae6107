"""A user's own effect: one formula over the covariates, read by an evaluator that knows nothing but arithmetic.

The text is parsed by Python's ``ast`` and never run: only numbers, the covariates' names, + - * / **, comparisons,
and/or/not and a dozen functions are let through; everything else is refused with its position. Length, depth and
exponents are bounded, so no text can take long or grow large, and a result that is not finite is refused.
"""

import ast
import json
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from calib_core.effects import library
from calib_core.effects.base import Acts, Covariates, Effect, Param, Stage
from calib_core.problem import Problem

F64 = NDArray[np.float64]

COVARIATES = (
    "time_s", "rate_dps", "position_deg", "temperature_c", "supply_v", "direction", "acceleration_dps2",
    "other_rate_dps", "tilt_deg",
)  # fmt: skip
OPTIONAL = ("temperature_c", "supply_v", "other_rate_dps", "tilt_deg")
CONSTANTS = {"pi": np.pi}
MOST_CHARACTERS, MOST_PARTS, MOST_DEPTH = 400, 150, 25
LARGEST_EXPONENT = 8.0
NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
PARAMETER = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,19}")
ACTS = {"output": (Acts.OUTPUT, Stage.ELECTRICS), "rate": (Acts.RATE, Stage.SENSOR), "angle": (Acts.ANGLE, Stage.TABLE)}

BINARY: Mapping[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: np.divide, ast.Pow: np.power,
}  # fmt: skip
COMPARE: Mapping[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge, ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}  # fmt: skip
FUNCTIONS: Mapping[str, tuple[int, int, Callable[..., Any]]] = {
    "abs": (1, 1, np.abs), "sin": (1, 1, np.sin), "cos": (1, 1, np.cos), "exp": (1, 1, np.exp), "log": (1, 1, np.log),
    "sqrt": (1, 1, np.sqrt), "sign": (1, 1, np.sign), "radians": (1, 1, np.radians),
    "min": (2, 4, lambda *x: np.minimum.reduce(np.broadcast_arrays(*x))),
    "max": (2, 4, lambda *x: np.maximum.reduce(np.broadcast_arrays(*x))),
    "clip": (3, 3, lambda x, low, high: np.minimum(np.maximum(x, low), high)),
    "where": (3, 3, lambda condition, yes, no: np.where(np.asarray(condition) != 0.0, yes, no)),
}  # fmt: skip
"""Least and most arguments, and what is done with them; angles in radians."""


@dataclass(frozen=True, eq=False)
class Formula:
    """A checked formula. Called with covariates (n,) by name it gives (n,); comparisons give 0 and 1."""

    text: str
    tree: ast.expr
    names: tuple[str, ...]
    """The covariates it uses."""

    @classmethod
    def of(cls, text: str) -> "Formula":
        """Reads ``text``; raises Problem ``formula.…`` with ``position`` (from 1) and ``part`` where it is refused."""
        flat = re.sub(r"\s", " ", text).rstrip()
        text = flat.lstrip()
        skipped = len(flat) - len(text)
        if not text:
            raise Problem("formula.empty")
        if len(text) > MOST_CHARACTERS:
            raise Problem("formula.too_long", length=len(text), most=MOST_CHARACTERS)
        try:
            tree = ast.parse(text, mode="eval").body
        except SyntaxError as error:
            at = min(error.offset or len(text), len(text)) - 1  # no offset: the end came too soon
            raise Problem("formula.syntax", position=at + skipped + 1, part=text[at : at + 10]) from None
        except (ValueError, RecursionError, MemoryError):
            raise Problem("formula.syntax", position=skipped + 1, part=text[:10]) from None
        _bound(tree)
        names = _Check(text, skipped).names_of(tree)
        if not names:
            raise Problem("formula.no_covariate", covariates=", ".join(COVARIATES))
        return cls(text, tree, tuple(name for name in COVARIATES if name in names))

    def __call__(self, covariates: Mapping[str, F64]) -> F64:
        """Raises Problem ``formula.not_finite`` where a value is infinite or undefined."""
        with np.errstate(all="ignore"):
            values = np.asarray(_value(self.tree, covariates), float)
        values = np.array(np.broadcast_to(values, np.broadcast_shapes(*(covariates[n].shape for n in self.names))))
        bad = ~np.isfinite(values)
        if bad.any():
            first = int(bad.argmax())
            at = ", ".join(f"{name} = {float(covariates[name][first]):.6g}" for name in self.names)
            raise Problem("formula.not_finite", formula=self.text, count=int(bad.sum()), at=at)
        return values


def _bound(tree: ast.expr) -> None:
    """Refuses a tree that is too large or too deep, without recursion."""
    level: list[ast.AST] = [tree]
    parts = depth = 0
    while level:
        parts, depth = parts + len(level), depth + 1
        # Operators and load marks are nodes of their own kind: only expressions count.
        level = [c for node in level for c in ast.iter_child_nodes(node) if isinstance(c, ast.expr | ast.keyword)]
        if parts > MOST_PARTS or depth > MOST_DEPTH:
            raise Problem("formula.too_complex", parts=MOST_PARTS, depth=MOST_DEPTH)


class _Check:
    """Walks a bounded tree and refuses what is not arithmetic."""

    def __init__(self, text: str, skipped: int) -> None:
        self.text, self.skipped = text, skipped

    def names_of(self, node: ast.expr) -> set[str]:
        """The covariates under ``node``."""
        match node:
            case ast.Constant(value=bool()):
                raise self.refused("not_allowed", node)
            case ast.Constant(value=int() | float() as value):
                if not abs(value) < 1e100:
                    raise self.refused("number", node)
                return set()
            case ast.Name(id=name):
                if name in CONSTANTS:
                    return set()
                if name not in COVARIATES:
                    raise self.refused("unknown_name", node, covariates=", ".join(COVARIATES))
                return {name}
            case ast.UnaryOp(op=ast.UAdd() | ast.USub() | ast.Not(), operand=operand):
                return self.names_of(operand)
            case ast.BinOp(op=ast.BitXor()):
                raise self.refused("caret", node)
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                self.exponent(right)
                return self.names_of(left)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in BINARY:
                return self.names_of(left) | self.names_of(right)
            case ast.Compare(left=left, ops=ops, comparators=others) if all(type(op) in COMPARE for op in ops):
                return self.names_of(left).union(*map(self.names_of, others))
            case ast.BoolOp(values=values):
                return set().union(*map(self.names_of, values))
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in FUNCTIONS:
                least, most, _ = FUNCTIONS[name]
                if not least <= len(args) <= most:
                    raise self.refused("arguments", node, function=name, least=least, most=most, given=len(args))
                return set().union(*map(self.names_of, args))
            case ast.Call(func=ast.Name(id=name)) if name not in FUNCTIONS:
                raise self.refused("unknown_function", node, functions=", ".join(FUNCTIONS))
        raise self.refused("not_allowed", node)

    def exponent(self, node: ast.expr) -> None:
        """Exponents are numbers, and not large."""
        if self.names_of(node):
            raise self.refused("exponent", node, most=LARGEST_EXPONENT)
        with np.errstate(all="ignore"):
            value = float(_value(node, {}))
        if not abs(value) <= LARGEST_EXPONENT:
            raise self.refused("exponent", node, most=LARGEST_EXPONENT)

    def refused(self, code: str, node: ast.AST, **values: object) -> Problem:
        part = ast.get_source_segment(self.text, node) or self.text
        before = self.text.encode()[: getattr(node, "col_offset", 0)].decode(errors="ignore")
        return Problem(f"formula.{code}", position=self.skipped + len(before) + 1, part=part[:60], **values)


def _value(node: ast.expr, covariates: Mapping[str, F64]) -> Any:
    """The value of a checked tree."""
    match node:
        case ast.Constant(value=number):
            return np.float64(number)  # type: ignore[arg-type]
        case ast.Name(id=name):
            return np.float64(CONSTANTS[name]) if name in CONSTANTS else covariates[name]
        case ast.UnaryOp(op=op, operand=operand):
            value = _value(operand, covariates)
            return -value if isinstance(op, ast.USub) else value if isinstance(op, ast.UAdd) else 1.0 * (value == 0.0)
        case ast.BinOp(left=left, op=op, right=right):
            return BINARY[type(op)](_value(left, covariates), _value(right, covariates))
        case ast.Compare(left=left, ops=ops, comparators=others):
            sides = [_value(side, covariates) for side in (left, *others)]
            pairs = zip(ops, sides[:-1], sides[1:], strict=True)
            return np.prod(np.broadcast_arrays(*(1.0 * COMPARE[type(op)](a, b) for op, a, b in pairs)), axis=0)
        case ast.BoolOp(op=op, values=values):
            met = np.broadcast_arrays(*(np.asarray(_value(value, covariates)) != 0.0 for value in values))
            return 1.0 * (np.all(met, axis=0) if isinstance(op, ast.And) else np.any(met, axis=0))
        case ast.Call(func=ast.Name(id=name), args=args):
            return FUNCTIONS[name][2](*(_value(arg, covariates) for arg in args))
    raise AssertionError(node)


class UserEffect(Effect):
    """What users' effects have in common; ``effect_of`` makes the classes. The library does not list them."""

    formula: ClassVar[Formula]
    unit: ClassVar[str]

    @classmethod
    def missing(cls, c: Covariates) -> bool:
        """Also where the formula has no value, for instance a logarithm below zero."""
        if super().missing(c):
            return True
        try:
            cls.columns(c)
        except Problem:
            return True
        return False

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        (parameter,) = cls.linear()
        return {parameter: cls.formula({name: getattr(c, name) for name in cls.formula.names})}


def effect_of(name: str, formula: str, parameter: str, unit: str, acts: str = "output") -> type[UserEffect]:
    """The effect parameter·formula on the output, the rate the sensor feels, or the angle the encoder tells.

    Raises Problem ``formula.…`` for a name that is taken or odd, and for a formula that cannot be read.
    """
    if not NAME.fullmatch(name):
        raise Problem("formula.bad_name", name=name[:60])
    if name in library():
        raise Problem("formula.name_taken", name=name)
    words = {*dir(UserEffect), *UserEffect.__annotations__, *Effect.__annotations__, *COVARIATES, *FUNCTIONS, "values"}
    if not PARAMETER.fullmatch(parameter) or parameter in words:
        raise Problem("formula.bad_parameter", name=parameter[:60])
    if len(unit) > 40 or not unit.isprintable():
        raise Problem("formula.bad_unit", unit=unit[:60])
    if acts not in ACTS:
        raise Problem("formula.bad_acts", given=acts[:60], allowed=", ".join(ACTS))
    read = Formula.of(formula)
    on = {"output": "V +=", "rate": "rate +=", "angle": "encoder = angle +"}[acts]
    card = f"""A user's own effect.

    Equation:      {on} {parameter} ({read.text})
    Cause:         as its author supposes
    Signature:     residual follows the formula
    Confused with: whatever has the same shape in the motion at hand
    Excite it:     change {", ".join(read.names)}
    Source:        its author
    """
    where, stage = ACTS[acts]
    members = {
        "__doc__": card, "name": name, "acts": where, "stage": stage, "formula": read, "unit": unit,
        "needs": tuple(n for n in read.names if n in OPTIONAL),
        parameter: Param(unit, 1.0, (-1e12, 1e12), code=read.text),
    }  # fmt: skip
    return type("".join(word.capitalize() for word in name.split("_")), (UserEffect,), members)


def to_json(effect: type[UserEffect]) -> dict[str, str]:
    """What ``from_json`` makes the same effect of."""
    acts = next(key for key, (where, _) in ACTS.items() if where is effect.acts)
    (parameter,) = effect.linear()
    return {
        "name": effect.name,
        "formula": effect.formula.text,
        "parameter": parameter,
        "unit": effect.unit,
        "acts": acts,
    }


def from_json(saved: Mapping[str, object]) -> type[UserEffect]:
    """An effect from its JSON; raises Problem ``formula.…``, also for a key that is missing or no text."""
    wanted = ("name", "formula", "parameter", "unit", "acts")
    for key in wanted:
        if not isinstance(saved.get(key), str):
            raise Problem("formula.key_missing", key=key, keys=", ".join(wanted))
    name, formula, parameter, unit, acts = (str(saved[key]) for key in wanted)
    return effect_of(name, formula, parameter, unit, acts)


def from_text(text: str) -> list[type[UserEffect]]:
    """Effects from a JSON list of them; raises Problem ``formula.…``."""
    try:
        saved = json.loads(text)
    except ValueError:
        saved = None
    if not isinstance(saved, list) or not all(isinstance(one, dict) for one in saved):
        raise Problem("formula.not_a_list")
    return [from_json(one) for one in saved]
