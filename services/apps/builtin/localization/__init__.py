"""Cooperative localization of a target from ranges (thesis 4.3.3).

docs/reference/apps/localization.md has the equations.

Every robot measures its range to the target and its own place; together they find the target. All in metres.
"""

from services.apps.builtin.localization.diging import Diging
from services.apps.builtin.localization.flood import Flood
from services.apps.builtin.localization.info import Info
from services.apps.builtin.localization.moving import Moving
from services.apps.builtin.localization.nids import Nids
from services.apps.builtin.localization.thesis import Thesis

ALGORITHMS = {"info": Info, "nids": Nids, "flood": Flood, "diging": Diging, "thesis": Thesis, "moving": Moving}
