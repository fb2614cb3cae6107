"""Compensation as a C99 header."""

from calib_core.compensation import CLOSE_DPS, Compensation
from calib_core.compensation_body import Body, head, limits, plain
from calib_core.compensation_writer import Dialect, Writer

C = Dialect(
    braces=True,
    number="GYRO_R({})",
    either="{} ? {} : {}",
    functions={"abs": "fabs", "min": "fmin", "max": "fmax"},
    and_="&&",
    or_="||",
    field="state->",
)


def write_c(compensation: Compensation) -> str:
    """A C99 header: static inline functions, no allocation, double or whatever GYRO_REAL is defined as."""
    body = Body(compensation)
    prefix = f"gyro_{compensation.axis}"
    upper = prefix.upper()
    write = Writer(C, {name: f"{upper}_{name}" for name in body.constants})
    written = {name: f"GYRO_R({value!r})" for name, (value, _) in body.constants.items()}
    # Single precision cannot come closer than its own rounding.
    written |= {"CLOSE_DPS": f"GYRO_R(sizeof(GYRO_REAL) < sizeof(double) ? 1e-4 : {CLOSE_DPS!r})"}
    constants = [
        f"#define {upper}_{name} {written[name]} /* {plain(unit)} */" for name, (_, unit) in body.constants.items()
    ]
    state = f"{prefix}_state *state" if body.memory else ""
    arguments = ", ".join(filter(None, [state, *(f"GYRO_REAL {name}" for name in body.arguments)]))
    names = sorted(body.assigned)
    lines = [f"/* {line} */" if line else "" for line in head(compensation, body, f"{prefix}_rate_dps")]
    memory = [f"    GYRO_REAL {name};" for name in body.memory]
    reset = [f"    state->{name} = GYRO_R(0);" for name in body.memory]
    structure = [
        "/* What it remembers from sample to sample; reset before the first. */\ntypedef struct {\n"
        + "\n".join(memory),
        f"}} {prefix}_state;\n",
        f"static inline void {prefix}_reset({prefix}_state *state)\n{{\n" + "\n".join(reset) + "\n}\n",
    ]
    return "\n".join(
        [
            *lines,
            f"#ifndef {upper}_COMPENSATION_H\n#define {upper}_COMPENSATION_H\n",
            "#include <math.h>\n#include <tgmath.h>\n",
            "#ifndef GYRO_REAL\n#define GYRO_REAL double /* or float */\n#endif",
            "#ifndef GYRO_R\n#define GYRO_R(x) ((GYRO_REAL)(x))\n#endif\n",
            *constants,
            "",
            *(structure if body.memory else []),
            f"static inline GYRO_REAL {prefix}_rate_dps({arguments})\n{{",
            *([f"    GYRO_REAL {', '.join(names)};"] if names else []),
            *write.block(body.tree, 1),
            "}\n",
            *_limits_c(compensation, upper, prefix, body.output),
            f"#endif /* {upper}_COMPENSATION_H */\n",
        ]
    )


def _limits_c(compensation: Compensation, upper: str, prefix: str, output: str) -> list[str]:
    tests = [f"{output} {sign} {upper}_{name}" for name, sign, _ in limits(compensation)]
    if not tests:
        return []
    return [
        f"/* Whether the output is at a limit: then the rate is at least what is told. */\n"
        f"static inline int {prefix}_saturated(GYRO_REAL {output})\n{{\n    return {' || '.join(tests)};\n}}\n"
    ]
