"""The networks of FlashSAC and SimbaV2 as straight lines of 64-bit NumPy, from the authors' layers."""

from __future__ import annotations

import numpy as np

Parts = dict[str, np.ndarray]


def flashsac(parts: Parts, blocks: int, x: np.ndarray, moments: dict | None = None) -> tuple[np.ndarray, dict]:
    """Outputs, and the mean and unbiased variance that each normalisation met; `moments` are those it uses instead."""
    met = {}

    def normalise(name: str, x: np.ndarray) -> np.ndarray:
        mean, variance = x.mean(axis=0), x.var(axis=0)
        met[name] = np.stack([mean, x.var(axis=0, ddof=1)])
        if moments is not None:
            mean, variance = moments[name]
        scale, bias = parts[f"{name} affine"]
        return scale * (x - mean) / np.sqrt(variance + 1e-5) + bias

    x = normalise("inputs", x) @ parts["inputs kernel"]
    for block in range(blocks):
        inside = x @ parts[f"{block} wide kernel"]
        inside = np.maximum(normalise(f"{block} wide", inside), 0)
        inside = inside @ parts[f"{block} narrow kernel"]
        x = np.maximum(normalise(f"{block} narrow", inside), 0) + x
    x = x / np.sqrt((x**2).mean(axis=1, keepdims=True) + 1e-6) * parts["rms scale"]
    return x @ parts["outputs kernel"] + parts["outputs bias"], met


def simbav2(parts: Parts, blocks: int, width: int, heads: int, x: np.ndarray) -> np.ndarray:
    """Outputs; every scaler is stored times its scale over its start."""

    def sphere(x: np.ndarray) -> np.ndarray:
        return x / np.sqrt((x**2).sum(axis=1, keepdims=True))

    x = sphere(np.hstack([x, np.full((len(x), 1), 3.0)]))
    x = sphere(x @ parts["inputs kernel"] * parts["inputs scaler"])
    for block in range(blocks):
        inside = x @ parts[f"{block} wide kernel"] * parts[f"{block} wide scaler"]
        inside = sphere((np.maximum(inside, 0) + 1e-8) @ parts[f"{block} narrow kernel"])
        alpha = parts[f"{block} alpha"] * (1 / (blocks + 1)) / (1 / np.sqrt(width))
        x = sphere(x + alpha * (inside - x))
    outputs = []
    for head in range(heads):
        hidden = x @ parts[f"head {head} hidden kernel"] * parts[f"head {head} scaler"]
        outputs.append(hidden @ parts[f"head {head} kernel"] + parts[f"head {head} bias"])
    return np.hstack(outputs)
