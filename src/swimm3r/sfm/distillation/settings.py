"""Every number of medium-aware training, and the recipes; torch-free, so that --help is instant."""

from dataclasses import dataclass, field, replace
from typing import Literal

from swimm3r.datasets.settings import PairSettings
from swimm3r.settings import Count, CountOrZero, DecayingRate, NetworkSide, NotNegative, Seed, Settings, Share
from swimm3r.sfm.mast3r.settings import LoraSettings, ObjectiveSettings


@dataclass(frozen=True)
class TrainSettings(Settings):
    """Distillation of the frozen network into a low-rank student with the physics head (`sfm/distillation/loop.py`)."""

    lora: LoraSettings = field(default_factory=LoraSettings)
    objective: ObjectiveSettings = field(default_factory=ObjectiveSettings)
    pairs: PairSettings = field(default_factory=PairSettings)
    water_probability: Share = 0.5
    """p of the paper's parametric water-type augmentation. 0 turns it off and leaves out images taken in air, which
    have no raw image of their own."""
    learning_rate: DecayingRate = 5e-4
    cool_down: Share = 0.0
    """Share of the steps, at the end, in which the learning rate falls to 0 along a line; the paper names no
    schedule. Short trainings gain from it."""
    weight_decay: NotNegative = 1e-4
    epochs: Count = 20
    batch: Count = 4
    """Pairs per step, over all processes together."""
    micro_batch: CountOrZero = 0
    """Pairs per forward pass, their gradients added up to the batch; 0 is the whole batch. Less memory, same result."""
    size: NetworkSide = 512
    """Long side of the network's images, pixels."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Of the frozen trunk; adapters, heads and losses stay float32. auto: bfloat16 on a GPU."""
    seed: Seed = 0
    """Decides adapters, head, order of the pairs and water."""
    validation: CountOrZero = 16
    """Pairs drawn from the training sequences, never trained on, scored after each epoch; 0 for none."""
    max_pairs: CountOrZero = 0
    """Most pairs trained on, drawn evenly; 0 is no limit."""
    log_every: Count = 10
    """Steps between rows of metrics.jsonl, each the mean of its steps."""
    tensorboard: bool = False
    """Write the rows of metrics.jsonl for TensorBoard, too (pip install tensorboard)."""
    teacher_cache_mb: CountOrZero = 0
    """Disk for the teacher's features, so that it looks at each pair once: 20 MB per pair at 512 x 320. 0 computes them
    anew in each epoch."""
    checkpoint_every: Count = 200
    """Steps between states that an interrupted training goes on from; the end of an epoch is always one."""


def _without(*terms: Literal["forward", "inverse", "saturation"]) -> TrainSettings:
    paper = ObjectiveSettings()
    kept = {name: 0.0 if name in terms else getattr(paper, name) for name in ("forward", "inverse", "saturation")}
    return TrainSettings(objective=replace(paper, **kept))


RECIPES: dict[str, TrainSettings] = {
    "swimm3r": TrainSettings(),
    # Tab. swimm3r_flsea_ablation
    "without-forward": _without("forward"),
    "without-inverse": _without("inverse"),
    "without-saturation": _without("saturation"),
    "without-augmentation": replace(TrainSettings(), water_probability=0.0),
    # its caption: "disables all physics losses and parametric water augmentation"
    "distillation-only": replace(_without("forward", "inverse", "saturation"), water_probability=0.0),
    # Dark3R as a system of its own: three feature levels alike, the student also on clear images, no water
    "dark3r": TrainSettings(
        objective=ObjectiveSettings(
            encoder=1.0, decoder=1.0, descriptors=1.0, clean=0.3, forward=0.0, inverse=0.0, saturation=0.0
        ),
        water_probability=0.0,
    ),
}
