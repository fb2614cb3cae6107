"""Grading of a blind exercise: pure rules on names, with what the instrument says of the student's own data.

A finding is one name, or several that are declared a tie. A tie with the truth in it is right where the diagnosis of
the student's data ties the same names; where the data tell some of them apart it is half right. No finding at all is
an answer too.
"""

from collections.abc import Mapping, Sequence
from typing import Any

Words = dict[str, Any]
POINTS = {"right": 1.0, "tie": 1.0, "too_wide": 0.5, "wrong": 0.0}


def grade(hidden: Sequence[str], findings: Sequence[Sequence[str]], diagnosis: Mapping[str, Any] | None) -> Words:
    """Each finding's mark, what is missing, and a score from 0 to 1.

    A mark is right, tie, too_wide or wrong, with the truth it stands for; of a wrong name ``tied_with`` says which
    truth it was tied with in the student's data (the tie that should have been named). Every truth counts once, and a
    wrong finding costs as much as a missing one.
    """
    ties = _ties(diagnosis)
    left = list(hidden)
    marks: dict[int, Words] = {}
    # Plain names first: a tie must not take a truth that another finding names outright.
    for number in sorted(range(len(findings)), key=lambda k: len(findings[k])):
        names = list(dict.fromkeys(findings[number]))
        truth = next((name for name in names if name in left), None)
        mark: Words = {"names": names, "stands_for": truth, "told_apart": [], "tied_with": None}
        if truth is None:
            mark["mark"] = "wrong"
            if len(names) == 1:
                mark["tied_with"] = next((t for t in left if any({t, *names} <= tie for tie in ties)), None)
        else:
            left.remove(truth)
            mark["told_apart"] = [n for n in names if n != truth and not any({truth, n} <= tie for tie in ties)]
            mark["mark"] = "right" if len(names) == 1 else "too_wide" if mark["told_apart"] else "tie"
        marks[number] = mark
    in_order = [marks[number] for number in range(len(findings))]
    points = sum(POINTS[mark["mark"]] for mark in in_order)
    asked = max(len(hidden), len(findings))
    return {"marks": in_order, "missing": left, "score": round(points / asked, 3) if asked else 1.0}


def _ties(diagnosis: Mapping[str, Any] | None) -> list[set[str]]:
    """Which names the data cannot tell apart, an alternative that takes several effects with each of them."""
    if diagnosis is None or "message" in diagnosis:
        return []
    sets = [{name for names in alternatives for name in names} for alternatives in diagnosis["rival_sets"]]
    return [*(set(names) for names in diagnosis["rivals"]), *sets]
