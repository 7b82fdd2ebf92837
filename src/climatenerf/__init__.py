"""climatenerf: photos of a real place in; smog, flood and snow on that place out.

Importing this package loads neither torch nor numba; the command line and the sub-packages do so
when they need them.
"""

__version__ = "0.1.0"
