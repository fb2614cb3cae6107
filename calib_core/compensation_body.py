"""What compensates a gyro's output, as one function body that every language is written from.

The body is written below in a small piece of Python (assignments, if, for, break, return) over formulas of the effects'
parameters. What it computes is what ``Compensation.rate`` computes; ``compensation_writer`` turns it into a language.
"""

import ast
import re
from collections.abc import Mapping, Sequence
from typing import Any

from calib_core.compensation import CLOSE_DPS, FASTEST_DPS, OWN_WAY, SWAYING_DPS, TURNS, Compensation
from calib_core.effects import Acts, Effect
from calib_core.integral_fit import SUFFIX

INPUTS = {
    "time_s": "s, since the start of the recording that the model was fitted to (since switching on, for a warm-up)",
    "temperature_c": "degC, at the gyro",
    "supply_v": "V, supply of the gyro",
    "other_rate_dps": "deg/s, about the other axis of the table",
    "position_deg": "deg, angle about this axis",
    "tilt_deg": "deg, angle of the x axis, which turns gravity in the sensor",
    "x_acceleration_g": "g, specific force along x",
    "y_acceleration_g": "g, specific force along y",
    "z_acceleration_g": "g, specific force along z",
}
"""What may be asked for beside the output, in the order of the arguments."""
MOVING = {"rate_dps", "direction"}
REASONS = {
    "encoder": "an error of the encoder, not of the gyro",
    "acceleration": "its formula needs the angular acceleration",
    "phase": "its phase is another in every recording",
    "random": "it cannot be foretold",
    "rounding": "rounding cannot be undone",
    "clock": "it is the time stamps that need correction",
    "unwritten": "it has no formula",
}
"""Why effects are left out, by the words of ``Compensation.left_out``."""


def inputs(compensation: Compensation) -> tuple[str, ...]:
    """The arguments of the written function, the output first."""
    return Body(compensation).arguments


def head(compensation: Compensation, body: "Body", function: str) -> list[str]:
    unit = compensation.model.unit
    effects = ", ".join(compensation.undone) or "none"
    late = compensation.delay_s
    lines = [
        f"Rate of a gyro about axis {compensation.axis}, board {compensation.board or 'not told'}.",
        f"Written by gyrobench. Source: {', '.join(f'{k} {v}' for k, v in compensation.source.items()) or 'not told'}.",
        "",
        f"{function} gives deg/s. Effects undone: {effects}.",
        f"{body.output}: {unit}, the gyro's output",
        *(f"{name}: {INPUTS[name]}" for name in body.arguments[1:]),
    ]
    if late:
        lines.append(f"The rate was felt {late!r} s before the sample's time stamp.")
    if compensation.halved:
        lines.append("The rate is the mean since the last sample: felt half a sampling interval earlier.")
    if body.turns:
        lines.append("Not a number where the model has no answer for such an output.")
    lines += [f"Not undone: {name} ({REASONS[reason]})." for name, reason in compensation.left_out]
    lines += ["", *(_row(row) for row in compensation.rows)]
    return [plain(line) for line in lines]


def _row(row: Mapping[str, Any]) -> str:
    spread = row.get("standard_uncertainty")
    return f"{row['name']} = {row['value']!r} {row.get('unit', '')}" + (
        f", standard uncertainty {spread!r}" if spread else ""
    )


def plain(text: str) -> str:
    """Text that ends no comment and no docstring, in ASCII."""
    flat = re.sub(r"[^\x20-\x7e]", "?", text.replace("°", "deg "))
    return flat.replace("*/", "* /").replace("/*", "/ *").replace('"""', "'''").replace("\\", "/")


def limits(compensation: Compensation) -> list[tuple[str, str, float]]:
    rows = {row["name"]: float(row["value"]) for row in compensation.rows}
    both = (("V_lo", "<="), ("V_hi", ">="))
    return [(f"SATURATION_{n.upper()}", s, rows[f"saturation.{n}"]) for n, s in both if f"saturation.{n}" in rows]


class Body:
    """The function's body as a tree, with its constants, arguments, memory and local names."""

    def __init__(self, compensation: Compensation) -> None:
        self.compensation = compensation
        model, unit = compensation.model, compensation.model.unit
        self.output = f"output_{SUFFIX[unit]}"
        self.constants: dict[str, tuple[float, str]] = {
            "BIAS": (model.bias, unit),
            "SCALE_FACTOR": (model.scale_factor, f"{unit} per deg/s"),
        }
        self.memory: list[str] = []
        self.lagged: list[str] = []
        terms = [term for e in compensation.effects if e.name not in OWN_WAY for term in self.terms(e)]
        lines = self.lines(terms)
        self.constants |= {name: (value, unit) for name, _, value in limits(compensation)}
        self.tree = ast.parse("\n".join(lines)).body
        names = [n for node in self.tree for n in ast.walk(node) if isinstance(n, ast.Name)]
        used = {n.id for n in names}
        self.assigned = {n.id for n in names if isinstance(n.ctx, ast.Store)} - {"turn", "attempt"}
        self.arguments = (self.output, *(name for name in INPUTS if name in used and name not in self.assigned))
        self.turns = "turn" in used

    def constant(self, name: str, value: float, unit: str) -> str:
        """A name for the value; a number is added to one that is taken."""
        name = name.upper()
        while name in self.constants and self.constants[name] != (value, unit):
            name += "_"
        self.constants[name] = (value, unit)
        return name

    def parameter(self, effect: Effect, name: str) -> str:
        unit = effect.parameters()[name].unit.replace("{out}", self.compensation.model.unit)
        return self.constant(f"{effect.name}_{name}", effect.values[name], unit)

    def terms(self, effect: Effect) -> list[tuple[Acts, str]]:
        """What the effect adds, each linear parameter's formula over constants, arguments and memory."""
        found = []
        for name in effect.linear():
            if effect.values[name] == 0.0:
                continue
            tree = ast.parse(effect.parameters()[name].code, mode="eval").body
            used = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}
            settings = {n: self.parameter(effect, n) for n in effect.nonlinear() if n in used}
            tree = _Named(settings, self).visit(tree)
            found.append((effect.acts, f"{self.parameter(effect, name)} * ({ast.unparse(tree)})"))
        return found

    def lines(self, terms: Sequence[tuple[Acts, str]]) -> list[str]:
        """The body. A term that depends on the rate is taken out by turns."""
        value = self.compensation.value

        def own(effect: str, parameter: str) -> str:
            found = next(e for e in self.compensation.effects if e.name == effect)
            return self.parameter(found, parameter)

        lag, feel = value("bandwidth_lag", "tau") > 0.0, value("angular_acceleration", "k")
        band, loss = value("dead_band", "d") > 0.0, value("input_loading", "loss") != 0.0
        moving = [t for t in terms if _names(t[1]) & MOVING]
        still = [t for t in terms if t not in moving]
        turned = any("direction" in _names(t) for _, t in terms)
        remembers = bool(self.lagged or lag or feel or turned)
        text = "\n".join(t for _, t in terms) + "\n".join(self.lagged)
        lines: list[str] = []
        if remembers and (self.lagged or lag or feel):
            lines += ["elapsed_s = where(state.started > 0, time_s - state.time_s, 0)"]
        if "warmth" in text:
            zero = self.constant("REFERENCE_TEMPERATURE_C", self.compensation.reference["temperature_c"], "degC")
            lines += [f"warmth = temperature_c - {zero}"]
        lines += self.lagged
        level = self.output
        if loss:
            share, zero = own("input_loading", "loss"), own("input_loading", "V_input")
            level = f"({level} - {share} * {zero}) / (1 - {share})"
        fixed = "".join(f" - {t}" for acts, t in still if acts is Acts.OUTPUT)
        lines += [f"level = {level} - BIAS{fixed}"]
        if lag:
            lines += [f"keep = where(elapsed_s > 0, exp(-elapsed_s / {own('bandwidth_lag', 'tau')}), 0)"]
        if feel:
            rate = f"{own('angular_acceleration', 'k')} / elapsed_s"
            lines += [f"share = where(elapsed_s > 0, {rate}, 0)"]
        step = [f"felt = (level{''.join(f' - {t}' for acts, t in moving if acts is Acts.OUTPUT)}) / SCALE_FACTOR"]
        sensed = "(felt - keep * state.felt) / (1 - keep)" if lag else "felt"
        step += [f"sensed = {sensed}{''.join(f' - {t}' for acts, t in terms if acts is Acts.RATE)}"]
        if band:
            turning = self.constant("TURNING_DPS", self.compensation.turning_dps, "deg/s")
            shift = f"where(sensed > 0, {own('dead_band', 'd')}, -{own('dead_band', 'd')})"
            step += [f"sensed = where(abs(sensed) > {turning}, sensed + {shift}, 0)"]
        if feel > 0.0:
            step += ["following = (sensed + share * state.rate_dps) / (1 + share)"]
        elif feel < 0.0:
            step += ["following = where(state.started > 0, sensed - share * (sensed - state.sensed), sensed)"]
        else:
            step += ["following = sensed"]
        if turned:
            lines += ["direction = state.direction"]
        if moving:
            close = self.constant("CLOSE_DPS", CLOSE_DPS, "deg/s")
            fastest = self.constant("FASTEST_DPS", FASTEST_DPS, "deg/s")
            turns = [
                "before = rate_dps",
                f"for turn in range({TURNS}):",
                *(f"    {line}" for line in step),
                "    before = rate_dps",
                f"    rate_dps = clip(following, -{fastest}, {fastest})",
                f"    if abs(rate_dps - before) < {close}:",
                "        break",
            ]
            lines += ["rate_dps = level / SCALE_FACTOR", *self.turning(turns, turned)]
        else:
            lines += [*step, "rate_dps = following"]
        if remembers:
            self.memory += ["started"]
            lines += ["state.started = 1"]
            if self.lagged or lag or feel:
                self.memory += ["time_s"]
                lines += ["state.time_s = time_s"]
            kept = {"felt": lag, "sensed": feel < 0.0, "rate_dps": feel > 0.0, "direction": turned}
            for name in (name for name, needed in kept.items() if needed):
                self.memory += [name]
                lines += [f"state.{name} = {name}"]
        if moving:
            swaying = self.constant("SWAYING_DPS", SWAYING_DPS, "deg/s")
            lost = f"abs(rate_dps - before) > {swaying} or abs(rate_dps) >= {fastest}"
            lines += [f"if {lost}:", "    return nan", "rate_dps = (rate_dps + before) / 2"]
        return [*lines, "return rate_dps"]

    def turning(self, turns: list[str], turned: bool) -> list[str]:
        """The turns, and once more where they show that the direction has changed."""
        if not turned:
            return turns
        turning = self.constant("TURNING_DPS", self.compensation.turning_dps, "deg/s")
        newly = f"where(rate_dps > {turning}, 1, where(rate_dps < -{turning}, -1, direction))"
        return [
            "for attempt in range(2):",
            *(f"    {line}" for line in turns),
            f"    turned = {newly}",
            "    if turned == direction:",
            "        break",
            "    direction = turned",
        ]


def _names(text: str) -> set[str]:
    return {n.id for n in ast.walk(ast.parse(text, mode="eval")) if isinstance(n, ast.Name)}


class _Named(ast.NodeTransformer):
    """Puts constants in place of settings and of what the reference says, and memory in place of ``lagged``."""

    def __init__(self, settings: Mapping[str, str], body: Body) -> None:
        self.settings, self.body = settings, body

    def visit_Name(self, node: ast.Name) -> ast.expr:
        if node.id == "reference_supply_v":
            zero = self.body.constant("REFERENCE_SUPPLY_V", self.body.compensation.reference["supply_v"], "V")
            return ast.Name(zero, ast.Load())
        return ast.Name(self.settings.get(node.id, node.id), ast.Load())

    def visit_Call(self, node: ast.Call) -> ast.expr:
        if not (isinstance(node.func, ast.Name) and node.func.id == "lagged"):
            node.args = [self.visit(arg) for arg in node.args]
            return node
        value, tau = (ast.unparse(self.visit(arg)) for arg in node.args)
        slow = f"slow_{sum('keep' in line for line in self.body.lagged) // 2 + 1}"
        gain = f"(1 - keep_{slow}) / 2"
        self.body.memory += [slow, f"{slow}_input"]
        self.body.lagged += [
            f"keep_{slow} = exp(-elapsed_s / {tau})",
            f"state.{slow} = where(state.started > 0, "
            f"keep_{slow} * state.{slow} + {gain} * ({value} + state.{slow}_input), {value})",
            f"state.{slow}_input = {value}",
        ]
        return ast.Attribute(ast.Name("state", ast.Load()), slow, ast.Load())
