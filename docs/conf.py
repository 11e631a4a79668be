"""How the pages become a site: `make docs`. Nothing is fetched, and nothing in the site loads from elsewhere."""

import sys
from importlib.metadata import version as version_of
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))  # the generators stand beside the pages and are installed nowhere

from docs.generators import write_pages  # noqa: E402
from docs.generators.example_certificate import write_example  # noqa: E402
from docs.generators.gallery import write_gallery  # noqa: E402
from docs.generators.pictures import write_all  # noqa: E402
from docs.generators.results import write_schemas  # noqa: E402

project = "Calibration bench"
author = "the authors of triaxial-bench"
version = release = version_of("triaxial-bench")

extensions = ["myst_parser", "docs.site_parts"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build", "generators", "gallery", "**/_*.md"]
templates_path: list[str] = []

myst_enable_extensions = ["deflist", "colon_fence", "attrs_inline"]
myst_heading_anchors = 3
# a link to a page, a heading or a file of ours that is not there is a warning, and every warning an error
nitpicky = True
# quotes and ellipses are set, dashes are not: `--dry-run` in a text from the program stays an option
smartquotes_action = "qe"

html_theme = "furo"
html_title = f"Calibration bench {release}"
html_show_copyright = False
html_copy_source = False
html_show_sourcelink = False
html_static_path = ["static"]
html_extra_path = ["reference/served"]
html_css_files = ["site.css"]
html_theme_options = {"sidebar_hide_name": False, "navigation_with_keys": True}
pygments_style = "default"
pygments_dark_style = "monokai"

write_all()
write_pages(HERE / "reference")
write_gallery(HERE / "reference")
write_example(HERE / "reference")
write_schemas(HERE / "reference" / "served" / "schemas")
