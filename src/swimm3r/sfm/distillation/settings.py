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
    """Probability of the paper's parametric water augmentation; 0 turns it off and leaves out images taken in air."""
    learning_rate: DecayingRate = 5e-4
    """Learning rate of AdamW for adapters and physics head."""
    cool_down: Share = 0.0
    """Share of the steps, at the end, over which the learning rate falls linearly to 0."""
    weight_decay: NotNegative = 1e-4
    """Weight decay of AdamW for all trained parameters."""
    epochs: Count = 20
    """Number of passes over the training pairs."""
    batch: Count = 4
    """Pairs per step, over all processes together."""
    micro_batch: CountOrZero = 0
    """Pairs per forward pass, whose gradients are added up to the batch; 0 uses the whole batch. Smaller values save
    memory."""
    size: NetworkSide = 512
    """Longer side of the network's images in pixels."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Number format of the frozen trunk; auto uses bfloat16 on a GPU. Adapters, heads and losses use float32."""
    seed: Seed = 0
    """Seed of adapters, head, order of the pairs and water."""
    validation: CountOrZero = 16
    """Number of pairs held back from the training sequences and scored after each epoch; 0 for none."""
    max_pairs: CountOrZero = 0
    """Largest number of training pairs, drawn evenly; 0 sets no limit."""
    log_every: Count = 10
    """Steps between two rows of metrics.jsonl, each the mean of its steps."""
    tensorboard: bool = False
    """Write the rows of metrics.jsonl for TensorBoard too (pip install tensorboard)."""
    teacher_cache_mb: CountOrZero = 0
    """Disk in MB for the teacher's features, about 20 MB per pair at 512 x 320, so that each pair is encoded once; 0
    encodes it in each epoch."""
    checkpoint_every: Count = 200
    """Steps between two states that an interrupted training resumes from; the end of an epoch is always one."""


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
