"""A small bench for the test readings: strokes at constant rate, a 10-bit encoder with its own times, a gyro in volts.

Independent of calib_core/twin.py, so that the tests of the tests do not lean on it.
"""

import numpy as np

from calib_core.recording import Recording

STEP = 300.0 / 1023.0
BIAS, SCALE = 1.26, 0.0059
LAG_S = 0.04
"""The table follows its command like a first-order lag."""


def table(moves, dt=0.001):
    """[(segment, start_deg, end_deg, rate_dps, before_s, after_s)] -> time, commanded angle, index of the move."""
    angle, index = [], []
    for i, (_, start, end, rate, before, after) in enumerate(moves):
        way = np.arange(0.0, abs(end - start) / rate, dt) * rate * np.sign(end - start) + start
        piece = [np.full(round(before / dt), start), way, np.full(round(after / dt), end)]
        angle += piece
        index.append(np.full(sum(map(len, piece)), i))
    command = np.concatenate(angle)
    return np.arange(len(command)) * dt, command, np.concatenate(index)


def record(moves, seed=0, noise_V=0.0012, header=None, truth=lambda rate: BIAS + SCALE * rate):
    """A recording of ``moves``; ``truth`` maps rate to volts."""
    rng = np.random.default_rng(seed)
    time, command, index = table(moves)
    blend = 0.001 / LAG_S
    angle, at = np.empty_like(command), command[0]
    for i, goal in enumerate(command.tolist()):
        at += blend * (goal - at)
        angle[i] = at
    rate = np.gradient(angle, 0.001)
    rows = len(time) // 10
    volts = truth(rate)[: rows * 10].reshape(rows, 10).mean(1) + noise_V * rng.standard_normal(rows)
    row_time = time[: rows * 10].reshape(rows, 10).mean(1)
    read_at = row_time + rng.uniform(-0.003, 0.003, rows)
    codes = np.round(np.interp(read_at, time, angle) / STEP) * STEP
    names = tuple(dict.fromkeys(move[0] for move in moves))
    code_of = np.array([names.index(move[0]) for move in moves], np.int32)
    return Recording(
        np.round(row_time, 6),
        {
            "x_gyro_v": np.round(volts, 6),
            "x_position_deg": np.round(codes, 4),
            "x_position_time_s": np.round(read_at, 6),
        },
        code_of[index[: rows * 10 : 10]],
        names,
        header or {"board": "T1"},
    )


def rate_moves(set_points=(-60, -20, 10, 60, 100), readings=2, test="linearity"):
    moves = []
    at = 0.0
    for reading in range(1, readings + 1):
        for rate in set_points:
            end = 0.9 * rate
            moves.append(("move", at, -end, 120.0, 0.0, 0.3))
            moves.append((f"rate_x/{test}/{rate:+g}/{reading}", -end, end, abs(rate), 0.0, 0.4))
            at = end
    return [*moves, ("move", at, 0.0, 120.0, 0.0, 0.3)]


def position_moves(set_points=(-120, -30, 30, 90), readings=2, test="linearity"):
    moves = []
    for reading in range(1, readings + 1):
        for angle in set_points:
            moves.append((f"position_x/{test}/{angle:+g}/{reading}", 0.0, angle, 50.0, 0.2, 0.4))
            moves.append(("move", angle, 0.0, 100.0, 0.0, 0.2))
    return moves
