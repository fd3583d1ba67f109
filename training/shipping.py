"""From which score on a detection counts, chosen on scenes that are neither trained on nor judged. Pure."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from sightline.evaluation.score.detectors import FrameResult, LabelMatches

MOST_FALSE: Final = 0.02
"""Of false alarms and of wrong objects, in every column. A judge allows 5 of a hundred frames without a ball: what is
at 2 % by nature has more than that once in sixty such hundreds, at 3 % once in twelve."""
_TRIED: Final = tuple(round(float(one), 2) for one in np.arange(0.06, 0.95, 0.01))
_OTHERWISE: Final = 0.3  # for a label that no scene showed


def ball_threshold(columns: Mapping[str, Sequence[FrameResult]]) -> float:
    """The least score that keeps every column within `MOST_FALSE`; else the one that comes nearest to it."""
    worst = {least: max(_worst(frames, least) for frames in columns.values()) for least in _TRIED}
    within = [least for least, share in worst.items() if share <= MOST_FALSE]
    return within[0] if within else min(_TRIED, key=lambda least: worst[least])


def _worst(frames: Sequence[FrameResult], least: float) -> float:
    """The larger of the shares of false alarms and of wrong objects, if only scores from `least` on counted."""
    empty = [one for one in frames if not one.has_ball]
    alarms = sum(one.verdict != "none" and one.score >= least for one in empty)
    wrong = sum(one.verdict == "wrong object" and one.score >= least for one in frames)
    return max(alarms / max(1, len(empty)), wrong / max(1, len(frames)))


def label_threshold(found: LabelMatches) -> float:
    """The score with the best balance of found objects and right answers, the former twice as important (F2; van
    Rijsbergen, Information Retrieval, 1979): legs or a light that is overlooked is worse than one too many."""
    if not found.objects or not found.marks:
        return _OTHERWISE
    marks = sorted(found.marks, reverse=True)
    right, best, chosen = 0, 0.0, _OTHERWISE
    for count, (score, is_right) in enumerate(marks, start=1):
        right += is_right
        balance = 5 * right / (count + 4 * found.objects)
        if balance > best:
            best, chosen = balance, score
    return float(np.clip(chosen, _TRIED[0], _TRIED[-1]))
