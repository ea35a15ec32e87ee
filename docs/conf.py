"""The documentation's site, built by `make docs`: pages as they stand, the gallery run, the reference generated."""

import sys
from importlib.metadata import version as version_of
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_site"))

import notebooks  # noqa: E402  (found in the folder above)
import reference  # noqa: E402

project = "heliograph"
author = "The heliograph authors"
release = version = version_of("heliograph")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_gallery.gen_gallery"]
exclude_patterns = ["gallery", "_site", "_made/gallery/GALLERY_HEADER.rst"]
templates_path: list[str] = []

# Pages: plain markdown that reads well without this site too; a heading is an anchor.
myst_heading_anchors = 3
suppress_warnings = ["config.cache"]  # the gallery's order is a function

# Reference: what the docstrings say, each name at its public place.
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
python_maximum_signature_line_length = 90
add_module_names = False
toc_object_entries_show_parents = "hide"

# Gallery: every example is run, and one that fails ends the build.
sphinx_gallery_conf = {
    "examples_dirs": ["gallery"],
    "gallery_dirs": ["_made/gallery"],
    "filename_pattern": r"\.py$",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_signature": False,
    "remove_config_comments": True,
    "min_reported_time": 60,
    "write_computation_times": False,
    "image_scrapers": ("matplotlib",),
    "matplotlib_animations": False,
    "capture_repr": (),
    "first_notebook_cell": notebooks.INSTALL,
}

html_theme = "pydata_sphinx_theme"
html_title = "heliograph"
html_context = {"default_mode": "auto"}
html_static_path = ["_site/static"]
html_css_files = ["heliograph.css"]
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {
    "logo": {"text": "heliograph"},
    "navbar_align": "left",
    "header_links_before_dropdown": 7,
    "navigation_depth": 2,
    "show_toc_level": 1,
    "secondary_sidebar_items": {"**": ["page-toc"], "coming_from": []},
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "tango",
}
html_sidebars = {"which_filter": [], "index": [], "comparisons": [], "coming_from": []}
copyright = "the heliograph authors, MIT license"


def setup(app: object) -> None:
    """Write the reference's pages before any page is read, and let it speak of signatures and docstrings."""
    reference.write_pages(HERE / "_made" / "api")
    reference.connect(app)
