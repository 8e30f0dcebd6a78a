"""`swimm3r datasets`: contents of a folder of published data, and the parts that cannot be used."""

from swimm3r.cli.terminal.options import DataRoot


def datasets(root: DataRoot, /) -> None:
    """List the sequences below a folder, their raw and clean images, depth and poses, and what was left out.

    Args:
        root: FLSea-VI, Sea-Thru, SeaThru-NeRF, synthetic dives or folders raw/ clean/ depth/, as unpacked.
    """
    from swimm3r.datasets import read_tree
    from swimm3r.datasets.tree import describe

    print(describe(read_tree(root)))
