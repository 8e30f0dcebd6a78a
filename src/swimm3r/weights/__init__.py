"""Model weights: where they come from, where they lie, what their license allows, whether they are whole.

Nothing here is bundled or re-distributed.
"""

from swimm3r.weights.download import fetch
from swimm3r.weights.manifest import MANIFEST, Weights, entry
from swimm3r.weights.store import Checked, directory, find, require, verify

__all__ = ["MANIFEST", "Checked", "Weights", "directory", "entry", "fetch", "find", "require", "verify"]
