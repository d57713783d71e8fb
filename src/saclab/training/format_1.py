"""Checkpoints of format 1, as saclab 0.1 wrote them until November 2026: their learner's arrays under today's names."""

from __future__ import annotations

import re

import numpy as np

Arrays = dict[str, np.ndarray]

RENAMED = {
    r"\.actor": ".actor.weights",
    r"\.critic": ".critic.weights",
    r"\.log_alpha": ".temperature.weights",
    r"\.target\.snapshots": ".targets",
    r"\.target\.entropy_terms": ".entropy_terms",
    r"\.optimizers\.(actor|critic|temperature)\[0\]\.(count|mu|nu)": r".\1.moments.\2",
    r"\.key": ".key",
}
METRICS = 9


def today(learner: Arrays) -> Arrays:
    """The group `learner` of a checkpoint of format 1 as format 2 has it.

    A fixed temperature had no moments, and no report was kept; both play no part in what follows.
    """
    renamed: Arrays = {}
    for name, array in learner.items():
        for old, new in RENAMED.items():
            if re.fullmatch(old, name):
                renamed[re.sub(old, new, name)] = array
    zero = np.zeros((), np.float32)
    step = learner.get(".step", np.zeros((), np.int32))
    missing = {".temperature.moments.count": step, ".temperature.moments.mu": zero, ".temperature.moments.nu": zero}
    return {**missing, ".report": np.zeros(METRICS, np.float32), **renamed}
