"""Public names of the room; the package loads them when first used."""

from .plan import (
    Campaign as Campaign,
)
from .read import (
    load_campaign as load_campaign,
)
from .run import (
    CampaignRun as CampaignRun,
    run_campaign as run_campaign,
)
from .summary import (
    open_results as open_results,
    read_summary as read_summary,
)
