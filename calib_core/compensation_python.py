"""Compensation as a Python module."""

from calib_core.compensation import Compensation
from calib_core.compensation_body import Body, head, limits, plain
from calib_core.compensation_writer import Dialect, Writer

PYTHON = Dialect(
    braces=False,
    number="{}",
    either="{1} if {0} else {2}",
    functions={name: f"math.{name}" for name in ("sin", "cos", "exp", "log", "sqrt", "radians")},
    and_="and",
    or_="or",
    field="state.",
)


def write_python(compensation: Compensation) -> str:
    """A Python module without imports beyond ``math``: ``rate_dps(…)``, and ``State`` where something is remembered."""
    body = Body(compensation)
    write = Writer(PYTHON, {name: name for name in body.constants})
    arguments = ", ".join([*(["state"] if body.memory else []), *body.arguments])
    told = "\n".join(head(compensation, body, "rate_dps"))
    return "\n".join(
        [
            f'"""{told}\n"""\n',
            "import math\n",
            *(f"{name} = {float(value)!r}  # {plain(unit)}" for name, (value, unit) in body.constants.items()),
            *(
                [
                    "\n\nclass State:",
                    '    """What it remembers from sample to sample; make a new one before the first."""\n',
                    "    def __init__(self):",
                    *(f"        self.{name} = 0.0" for name in body.memory),
                ]
                if body.memory
                else []
            ),
            f"\n\ndef rate_dps({arguments}):",
            *write.block(body.tree, 1),
            *_limits_python(compensation, body.output),
            "",
        ]
    )


def _limits_python(compensation: Compensation, output: str) -> list[str]:
    tests = [f"{output} {sign} {name}" for name, sign, _ in limits(compensation)]
    if not tests:
        return []
    says = "Whether the output is at a limit: then the rate is at least what is told."
    return [f'\n\ndef saturated({output}):\n    """{says}"""\n    return {" or ".join(tests)}']
