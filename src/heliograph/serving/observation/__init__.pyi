"""Names that other folders take; the package loads them when first used."""

from .page import parse_page_address as parse_page_address
from .page import serve_page as serve_page
from .service_watch import watch_of as watch_of
