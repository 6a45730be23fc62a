"""Scores of a walk: the papers' own verdicts, margins, and the touches and reflexes in a trace."""

from jaxbiped.score.loss import Loss, WalkLoss
from jaxbiped.score.recoveries import Recovery, recoveries
from jaxbiped.score.touches import Touch, touches, walked_rows
from jaxbiped.score.verdict import STATUS_TEXT, UNFINISHED, Verdict, judge, watch_time

__all__ = [
    "STATUS_TEXT",
    "UNFINISHED",
    "Loss",
    "Recovery",
    "Touch",
    "Verdict",
    "WalkLoss",
    "judge",
    "recoveries",
    "touches",
    "walked_rows",
    "watch_time",
]
