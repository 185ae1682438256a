"""The methods the paper compares with: NB07 and circular models, to be run side by side.

Importing this package gives them their names in `fdnt_xp.shapes.methods`: `nb07-8` and
`nb07-12` by their order, `nb07` for the first, `gauss-1` to `gauss-4`, `exponential` and
`devaucouleurs`.
"""

from fdnt_xp.peers.circular import CIRCULAR_METHODS
from fdnt_xp.peers.nb07 import NB07_METHODS
from fdnt_xp.shapes.methods import register_shape_method

register_shape_method("nb07", NB07_METHODS["nb07-8"])
for _name, _method in (NB07_METHODS | CIRCULAR_METHODS).items():
    register_shape_method(_name, _method)
