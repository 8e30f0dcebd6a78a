"""The plane sweep's kernels once more, slow and obvious: float64 NumPy, no packing, no early ends."""

import numpy as np

from swimm3r.sfm.plane_sweep.pixel_math import ROUGHEST, SAME


def transferred(lens: np.ndarray, x: float, y: float, q: float) -> np.ndarray:
    """The homogeneous point of a source on which a pixel at inverse depth q lands."""
    return lens[:9].reshape(3, 3) @ np.array([x, y, 1.0]) + q * lens[9:]


def sampled(image: np.ndarray, u: float, v: float) -> float:
    """The image between its pixels; positions outside are moved to the border."""
    h, w = image.shape
    u, v = np.clip(u, 0, w - 1.01), np.clip(v, 0, h - 1.01)
    i, j = int(u), int(v)
    a, b = u - i, v - j
    top, bottom = image[j, i : i + 2], image[j + 1, i : i + 2]
    return float((1 - b) * (top @ [1 - a, a]) + b * (bottom @ [1 - a, a]))


def sees(seen: np.ndarray, place: np.ndarray) -> bool:
    """A source sees a pixel that lands ahead of it, inside its image, on a pixel that is used."""
    X, Y, Z = place
    h, w = seen.shape
    inside = Z > 0 and 0 <= X / Z < w - 1.01 and 0 <= Y / Z < h - 1.01
    return bool(inside and seen[int(Y / Z), int(X / Z)])


def ncc_cost(r: np.ndarray, s: np.ndarray, weight: np.ndarray, noise: float) -> float:
    """1 - NCC of two weighted windows, at most 1."""
    weight = weight / weight.sum()
    mean_r, mean_s = weight @ r, weight @ s
    covariance = weight @ ((r - mean_r) * (s - mean_s))
    variances = (weight @ (r - mean_r) ** 2 + noise) * (weight @ (s - mean_s) ** 2 + noise)
    return float(np.clip(1 - covariance / np.sqrt(variances), 0, 1))


def sweep_costs(
    reference: np.ndarray,
    sources: np.ndarray,
    seen: np.ndarray,
    lenses: np.ndarray,
    planes: np.ndarray,
    radius: int,
    noise: float,
    keep: int,
) -> np.ndarray:
    """The cost volume [h, w, planes]."""
    h, w = reference.shape
    volume = np.empty((h, w, len(planes)))
    for d, q in enumerate(planes):
        costs = np.ones((len(sources), h, w))
        for n, lens in enumerate(lenses):
            warped, ok = np.zeros((h, w)), np.zeros((h, w), bool)
            for y in range(h):
                for x in range(w):
                    place = transferred(lens, x, y, q)
                    ok[y, x] = sees(seen[n], place)
                    if ok[y, x]:
                        warped[y, x] = sampled(sources[n], place[0] / place[2], place[1] / place[2])
            for y, x in zip(*np.nonzero(ok), strict=True):
                part = (slice(max(0, y - radius), y + radius + 1), slice(max(0, x - radius), x + radius + 1))
                r, s = reference[part].ravel(), warped[part].ravel()
                costs[n, y, x] = ncc_cost(r, s, np.ones(len(r)), noise)
        volume[..., d] = np.sort(costs, 0)[:keep].mean(0)
    return volume


def semi_global(volume: np.ndarray, guide: np.ndarray, small: float, large: float, edge: float) -> np.ndarray:
    """Costs summed along eight paths, each followed from its first pixel on."""
    h, w, planes = volume.shape
    total = np.zeros_like(volume)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        for y0 in range(h):
            for x0 in range(w):
                if 0 <= y0 - dy < h and 0 <= x0 - dx < w:
                    continue  # not the first of its path
                y, x, before = y0, x0, None
                while 0 <= y < h and 0 <= x < w:
                    now = volume[y, x].copy()
                    if before is not None:
                        change = abs(guide[y, x] - guide[y - dy, x - dx])
                        jump = max(small, large / (1 + change / edge))
                        for d in range(planes):
                            ways = [before[d], before.min() + jump]
                            ways += [before[k] + small for k in (d - 1, d + 1) if 0 <= k < planes]
                            now[d] += min(ways) - before.min()
                    total[y, x] += now
                    before, y, x = now, y + dy, x + dx
    return total


class Refinement:
    """One round of `refine`, pixel by pixel."""

    def __init__(
        self,
        reference: np.ndarray,
        guide: np.ndarray,
        sources: np.ndarray,
        seen: np.ndarray,
        lenses: np.ndarray,
        surface: np.ndarray,
        offsets: np.ndarray,
        *,
        noise: float,
        edge: float,
        keep: int,
        smooth: float,
        step: float,
        reach: int,
    ) -> None:
        self.reference, self.guide, self.sources, self.seen = reference, guide, sources, seen
        self.lenses, self.surface, self.offsets = lenses.astype(float), surface.astype(float), offsets.astype(int)
        self.noise, self.edge, self.keep = noise, edge, keep
        self.smooth, self.step, self.reach = smooth, step, reach

    def pixel(self, y: int, x: int) -> tuple[np.ndarray, float, float]:
        """The plane, its cost and its peak."""
        own = self.surface[y, x]
        r, weight = self._window(y, x)
        like = weight**2 / (weight**2).sum()
        if like @ r**2 - (like @ r) ** 2 < self.noise:
            return own, 1.0, 0.0
        first = np.array([self._patch(n, y, x, own, r, weight) for n in range(len(self.sources))])
        chosen = [n for k, n in enumerate(np.argsort(first, kind="stable")[: self.keep]) if k < 2 or first[n] < 1]
        speed = max(self._speed(n, y, x, own[0]) for n in chosen)
        move = self.step / speed

        def photometric(plane: np.ndarray) -> float:
            return float(np.mean([self._patch(n, y, x, plane, r, weight) for n in chosen]))

        def rough(q: float) -> float:
            apart = [abs(self._at(y + dy, x + dx, -dy, -dx) - q) * speed for dy, dx in _NEIGHBORS]
            return 0.25 * self.smooth * sum(min(a, ROUGHEST) for a in apart)

        center = first[chosen].mean()
        along = np.array([move, 0, 0])
        nearer, farther = own + along, own - along
        sides = [photometric(nearer), photometric(farther)]
        peak = min(sides) - center if farther[0] > 0 else 0.0  # no plane lies behind infinity
        if self.reach == 0:
            return own, center, peak
        at_minimum = own.copy()
        if peak > 0:
            at_minimum[0] += move * 0.5 * (sides[1] - sides[0]) / (sides[0] + sides[1] - 2 * center)
        candidates = [(center + rough(own[0]), center, at_minimum)]
        steps = [(dy * self.reach, dx * self.reach) for dy, dx in _NEIGHBORS]
        planes = [np.array([self._at(y + dy, x + dx, -dy, -dx), *self.surface[y + dy, x + dx, 1:]]) for dy, dx in steps]
        slopes = [0.25 * (self.surface[y, x + 2, 0] - self.surface[y, x - 2, 0]),
                  0.25 * (self.surface[y + 2, x, 0] - self.surface[y - 2, x, 0])]  # fmt: skip
        for plane in (*planes, nearer, farther, np.array([own[0], *slopes])):
            apart = abs(plane[0] - own[0]) + np.abs(self.offsets).max() * np.abs(plane[1:] - own[1:]).sum()
            if plane[0] > 0 and apart * speed >= SAME:
                cost = photometric(plane)
                candidates.append((cost + rough(plane[0]), cost, plane))
        _, cost, plane = min(candidates, key=lambda candidate: candidate[0])
        return plane, cost, peak

    def _window(self, y: int, x: int) -> tuple[np.ndarray, np.ndarray]:
        rows, columns = y + self.offsets[:, 1], x + self.offsets[:, 0]
        likeness = np.clip(1 - ((self.guide[rows, columns] - self.guide[y, x]) / self.edge) ** 2 / 16, 0, None) ** 8
        return self.reference[rows, columns], likeness / likeness.sum()

    def _patch(self, n: int, y: int, x: int, plane: np.ndarray, r: np.ndarray, weight: np.ndarray) -> float:
        if not sees(self.seen[n], transferred(self.lenses[n], x, y, plane[0])):
            return 1.0
        values = []
        for dx, dy in self.offsets:
            X, Y, Z = transferred(self.lenses[n], x + dx, y + dy, plane[0] + plane[1] * dx + plane[2] * dy)
            values.append(sampled(self.sources[n], X / Z, Y / Z))
        return ncc_cost(r, np.array(values), weight, self.noise)

    def _speed(self, n: int, y: int, x: int, q: float) -> float:
        step = 1e-6 * q
        (X, Y, Z), (X1, Y1, Z1) = (transferred(self.lenses[n], x, y, at) for at in (q - step, q + step))
        return float(np.hypot(X1 / Z1 - X / Z, Y1 / Z1 - Y / Z) / (2 * step))

    def _at(self, y: int, x: int, dy: int, dx: int) -> float:
        """q of the plane of pixel (y, x) at (dy, dx) from it."""
        return float(self.surface[y, x, 0] + self.surface[y, x, 1] * dx + self.surface[y, x, 2] * dy)


_NEIGHBORS = ((0, -1), (0, 1), (-1, 0), (1, 0))
