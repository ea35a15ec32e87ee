"""Public names of the room; the package loads them when first used."""

from .definition import (
    Campaign as Campaign,
)
from .campaign_file import (
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
