"""`swimm3r datasets`: what a folder of published data holds, and what of it cannot be used."""

from pathlib import Path

from tyro.conf import Positional


def datasets(root: Positional[Path], /) -> None:
    """List the sequences below a folder, their raw and clean images, depth and poses, and what was left out.

    Args:
        root: FLSea-VI, Sea-Thru, SeaThru-NeRF, synthetic dives or folders raw/ clean/ depth/, as unpacked.
    """
    from swimm3r.datasets import read_tree
    from swimm3r.datasets.tree import describe

    print(describe(read_tree(root)))
