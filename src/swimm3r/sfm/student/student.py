"""The trained part of medium-aware SfM: adapters on the frozen network, and the physics head on what it then encodes.

One copy of the weights is both networks: with the adapters off it is the teacher, which sees the clear images.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from swimm3r.sfm.mast3r.network import Encoded, Mast3r
from swimm3r.sfm.mast3r.settings import LoraSettings, ObjectiveSettings
from swimm3r.sfm.student.lora import Adapters, attach
from swimm3r.sfm.student.losses import (
    LossTerms,
    PairFeatures,
    features,
    known_water_loss,
    physics_terms,
    squared_distance,
)
from swimm3r.sfm.student.physics_head import PhysicsHead, WaterMaps


class Student(nn.Module):
    """Adapters and head, its only parameters; called with a batch of pairs it returns every term of the objective."""

    def __init__(
        self, network: Mast3r, adapters: Adapters, head: PhysicsHead | None, objective: ObjectiveSettings
    ) -> None:
        super().__init__()
        self.adapters = adapters
        self.head = head
        self.objective = objective
        self._network = (network,)  # in a tuple, and so no part of what is trained, stored or sent around

    @property
    def network(self) -> Mast3r:
        return self._network[0]

    def water(self, encoded: Encoded) -> WaterMaps:
        """The head's prediction from the student's tokens. Raises ValueError for a student without a head."""
        if self.head is None:
            raise ValueError("this student was trained without the physics head")
        return self.head(encoded)

    def forward(
        self,
        clean: Float[Tensor, "b 2 3 h w"],
        raw: Float[Tensor, "b 2 3 h w"],
        ray_depth: Float[Tensor, "b 2 h w"],
        valid: Bool[Tensor, "b 2 h w"],
        sampled_medium: Float[Tensor, "b 2 3 3"],
        teacher: PairFeatures | None = None,
    ) -> dict[str, Float[Tensor, " b"]]:
        """The fields of `LossTerms` of pairs of the network's images (-1..1); ray depth in m, read where valid.

        `sampled_medium` is Binf, beta_D and beta_B of the water the augmentation drew, NaN where it drew none.
        `teacher` is its features of the clear images, where they are known already.
        """
        s = self.objective
        if teacher is None:
            teacher = self.teacher(clean)
        student, encoded = self._features(raw)
        terms = self._distances(teacher, student)
        zero = raw.new_zeros(len(raw), dtype=torch.float32)
        for name in ("forward", "inverse", "overshoot", "anchor", "known_water", "clean"):
            terms[name] = zero
        if s.clean:
            again = self._distances(teacher, self._features(clean)[0])
            terms["clean"] = sum((getattr(s, level) * again[level] for level in again), zero)
        if self.head is not None and s.physics:
            I, J = (((p.flatten(0, 1) + 1) / 2).permute(0, 2, 3, 1).float() for p in (raw, clean))
            z, known = ray_depth.flatten(0, 1), valid.flatten(0, 1)
            medium = self.head(encoded).at(torch.where(known, z, 0.0))
            water = dict(vars(physics_terms(I, J, z, known, medium, s)))
            water["known_water"] = known_water_loss(z, known, medium, sampled_medium.flatten(0, 1))
            terms |= {name: values.unflatten(0, (-1, 2)).mean(1) for name, values in water.items()}
        return terms

    def teacher(self, clean: Float[Tensor, "b 2 3 h w"]) -> PairFeatures:
        """Features of the clear images of pairs, from the network without its adapters."""
        with torch.no_grad(), self.adapters.off():
            return self._features(clean)[0]

    def total(self, terms: dict[str, Float[Tensor, " b"]]) -> Float[Tensor, " b"]:
        """L_SfM of each pair."""
        return LossTerms(**terms).total(self.objective)

    def _features(self, images: Float[Tensor, "b 2 3 h w"]) -> tuple[PairFeatures, Encoded]:
        network = self.network
        both = network.encode(images.flatten(0, 1))
        view1, view2 = (Encoded(both.tokens[k::2], both.positions[k::2], both.height, both.width) for k in (0, 1))
        return features(network, view1, view2, self.objective), both

    def _distances(self, teacher: PairFeatures, student: PairFeatures) -> dict[str, Tensor]:
        s = self.objective
        zero = student.encoder[0].new_zeros(len(student.encoder[0]), dtype=torch.float32)
        return {
            level: squared_distance(getattr(teacher, level), getattr(student, level), s.reduction)
            if getattr(s, level)
            else zero
            for level in ("encoder", "decoder", "descriptors")
        }


def new_student(network: Mast3r, lora: LoraSettings, objective: ObjectiveSettings, seed: int) -> Student:
    """A student that still computes what its teacher does; the seed draws adapters and head."""
    adapters = attach(network, lora, torch.Generator().manual_seed(seed))
    head = None
    if objective.physics:
        with torch.random.fork_rng(devices=[]):  # torch's layers draw from the global generator only
            torch.manual_seed(seed)
            a = network.architecture
            head = PhysicsHead(a.encoder_dim, a.patch).to(network.decoder_embed.weight.device)
    return Student(network, adapters, head, objective)
