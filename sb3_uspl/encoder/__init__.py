"""Observation encoder: features (MLP, CNN), memory (GRU, Transformer with KV cache, maximum), belief head (mean, std)."""

from sb3_uspl.encoder.encoder import (
    MAX_STD,
    MIN_STD,
    PRESETS,
    Belief,
    DiscreteHead,
    ObservationEncoder,
    gaussian_nll,
    soft_clamp,
)
from sb3_uspl.encoder.features import FourierFeatures, ImageCNN, RunningNormalizer, TokenFeatures, Tokens, encode_actions
from sb3_uspl.encoder.memory import (
    MEMORIES,
    GRUMemory,
    MaxMemory,
    Memory,
    MemoryState,
    TransformerMemory,
    reset_rows,
    take_rows,
)

__all__ = [
    "MAX_STD",
    "MEMORIES",
    "MIN_STD",
    "PRESETS",
    "Belief",
    "DiscreteHead",
    "FourierFeatures",
    "GRUMemory",
    "ImageCNN",
    "MaxMemory",
    "Memory",
    "MemoryState",
    "ObservationEncoder",
    "RunningNormalizer",
    "TokenFeatures",
    "Tokens",
    "TransformerMemory",
    "encode_actions",
    "gaussian_nll",
    "reset_rows",
    "soft_clamp",
    "take_rows",
]
