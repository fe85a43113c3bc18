"""Recordings of pulls: format, tables, import, alignment, registration, checks.

Description of a recording, in SI units:

>>> from limber.recordings import GraspEntry, PullEntry
>>> entry = PullEntry(grasp=GraspEntry(point_m=(0.0, 0.0, 0.5), radius_m=0.01))
>>> entry.drive, entry.motion
('pose', 'quasi_static')
"""

from limber.core.optional import exports

_PLACES = {
    "GraspEntry": "recording",
    "ImportSettings": "settings",
    "ImportSpec": "settings",
    "Observations": "recording",
    "Pull": "recording",
    "PullEntry": "recording",
    "SensorEntry": "recording",
    "clean": "sensor_checks",
    "force_slope": "force_slope",
    "frames_of": "synchronisation",
    "import_recording": "importing",
    "read_pull": "recording",
    "read_table": "tables",
    "write_pull": "recording",
}

__getattr__, __dir__ = exports(__name__, _PLACES)
__all__ = list(_PLACES)
