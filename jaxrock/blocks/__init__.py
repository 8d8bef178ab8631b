"""Bodies that rock: rigid ones, symmetric or not, flexible columns, and laws of restitution for their impacts.

Imports `numerics`. Start with `rigid`. A new law of restitution is a class like those in `restitution`.
"""

from jaxrock._core.namespace import shown as _shown
from jaxrock.blocks import restitution as restitution
from jaxrock.blocks.asymmetric import AsymmetricBlock as AsymmetricBlock
from jaxrock.blocks.edge import Edge as Edge
from jaxrock.blocks.flexible import FlexibleBlock as FlexibleBlock
from jaxrock.blocks.planes import (
    WeakPlane as WeakPlane,
    shared_plane as shared_plane,
)
from jaxrock.blocks.random import (
    draw_blocks as draw_blocks,
    draw_rocks as draw_rocks,
)
from jaxrock.blocks.rigid import Block as Block
from jaxrock.blocks.rock import Rock as Rock


def __dir__() -> list[str]:
    return _shown(globals(), "restitution")
