"""The simulated objects as Gymnasium environments; `adaafford.gymnasium_ids` registers them.

Without Gymnasium or the simulator, the import is refused in one line.
"""

from shared.extras import require

require("a Gymnasium environment", "gym", "collect", without=("ray",))
