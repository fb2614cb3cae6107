"""Writes a function body, given as a checked tree, in a language that is told by its dialect."""

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

COMPARISONS = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}


@dataclass(frozen=True)
class Dialect:
    """How a language writes expressions."""

    braces: bool
    """Blocks in braces and statements with an end, as C has them."""
    number: str
    either: str
    functions: Mapping[str, str]
    and_: str
    or_: str
    field: str


ADDITION, PRODUCT, SIGN, POWER, ATOM = range(1, 6)


class Writer:
    """Writes a checked tree in a dialect, with as few brackets as its precedence needs."""

    def __init__(self, dialect: Dialect, constants: Mapping[str, str]) -> None:
        self.dialect, self.constants = dialect, constants
        self.c = dialect.braces
        self.zero = dialect.number.format("0")

    def block(self, body: Sequence[ast.stmt], depth: int) -> list[str]:
        return [line for statement in body for line in self.statement(statement, depth)]

    def statement(self, node: ast.stmt, depth: int) -> list[str]:
        pad, end = "    " * depth, ";" if self.c else ""
        match node:
            case ast.Assign(targets=[target], value=value):
                return [f"{pad}{self.of(target)} = {self.of(value)}{end}"]
            case ast.Return(value=ast.expr() as value):
                return [f"{pad}return {self.of(value)}{end}"]
            case ast.Break():
                return [f"{pad}break{end}"]
            case ast.If(test=test, body=body):
                head = f"if ({self.test(test)}) {{" if self.c else f"if {self.test(test)}:"
            case ast.For(target=ast.Name(id=name), iter=ast.Call(args=[ast.Constant(value=int(times))]), body=body):
                written = f"(int {name} = 0; {name} < {times}; {name}++) {{" if self.c else f"_ in range({times}):"
                head = f"for {written}"
            case _:
                raise AssertionError(ast.dump(node))
        return [f"{pad}{head}", *self.block(body, depth + 1), *([f"{pad}}}"] if self.c else [])]

    def of(self, node: ast.expr, above: int = 0) -> str:
        """The expression, in brackets where it binds less than ``above`` asks."""
        text, binds = self._of(node)
        return f"({text})" if binds < above else text

    def _of(self, node: ast.expr) -> tuple[str, int]:
        d = self.dialect
        match node:
            case ast.Constant(value=int() | float() as value):
                return d.number.format(f"{value:d}" if isinstance(value, int) else repr(value)), ATOM
            case ast.Name(id="pi"):
                return d.number.format("3.141592653589793"), ATOM
            case ast.Name(id="nan"):
                return "NAN" if self.c else "math.nan", ATOM
            case ast.Name(id=name):
                return self.constants.get(name, name), ATOM
            case ast.Attribute(attr=name):
                return f"{d.field}{name}", ATOM
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return f"-{self.of(operand, SIGN)}", SIGN
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self._of(operand)
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                return self.power(left, right)
            case ast.BinOp(left=left, op=op, right=right):
                binds = ADDITION if isinstance(op, ast.Add | ast.Sub) else PRODUCT
                return f"{self.of(left, binds)} {OPERATORS[type(op)]} {self.of(right, binds + 1)}", binds
            case ast.Compare() | ast.BoolOp() | ast.UnaryOp():
                return d.either.format(self.test(node), d.number.format("1"), self.zero), 0
            case ast.Call(func=ast.Name(id="where"), args=[condition, yes, no]):
                return d.either.format(self.test(condition), self.of(yes, 1), self.of(no, 1)), 0
            case ast.Call(func=ast.Name(id=name), args=args):
                return self.call(name, args)
        raise AssertionError(ast.dump(node))

    def test(self, node: ast.expr) -> str:
        """A condition."""
        d = self.dialect
        match node:
            case ast.Compare(left=left, ops=ops, comparators=others):
                sides = [self.of(side, ADDITION) for side in (left, *others)]
                pairs = zip(sides[:-1], ops, sides[1:], strict=True)
                return f" {d.and_} ".join(f"{a} {COMPARISONS[type(op)]} {b}" for a, op, b in pairs)
            case ast.BoolOp(op=op, values=values):
                word = d.and_ if isinstance(op, ast.And) else d.or_
                return f" {word} ".join(f"({self.test(value)})" for value in values)
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return f"{self.of(operand, ADDITION)} == {self.zero}"
        return f"{self.of(node, ADDITION)} != {self.zero}"

    def power(self, left: ast.expr, right: ast.expr) -> tuple[str, int]:
        if not self.c:
            return f"{self.of(left, ATOM)}**{self.of(right, SIGN)}", POWER
        if isinstance(left, ast.Name) and isinstance(right, ast.Constant) and right.value in (2, 3):
            return " * ".join([self.of(left)] * (2 if right.value == 2 else 3)), PRODUCT
        return f"pow({self.of(left)}, {self.of(right)})", ATOM

    def call(self, name: str, args: Sequence[ast.expr]) -> tuple[str, int]:
        if name == "sign":
            x = self.of(args[0], ADDITION)
            one = self.dialect.number.format("1")
            up, down = (self.dialect.either.format(f"{x} {side} {self.zero}", one, self.zero) for side in "><")
            return f"({up}) - ({down})", ADDITION
        texts = [self.of(arg) for arg in args]
        if name == "clip":
            return self.nested("min", [self.nested("max", texts[:2]), texts[2]]), ATOM
        if name in ("min", "max"):
            return self.nested(name, texts), ATOM
        if name == "radians" and self.c:
            return f"{self.of(args[0], PRODUCT)} * GYRO_R(0.017453292519943295)", PRODUCT
        return f"{self.dialect.functions.get(name, name)}({', '.join(texts)})", ATOM

    def nested(self, name: str, texts: Sequence[str]) -> str:
        """C's take two."""
        *first, last = texts
        if self.c and len(first) > 1:
            first = [self.nested(name, first)]
        return f"{self.dialect.functions.get(name, name)}({', '.join([*first, last])})"
