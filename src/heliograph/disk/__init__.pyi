"""Names that other folders take; the package loads them when first used."""

from .atomic_files import FORMATS as FORMATS
from .atomic_files import check_folder_writable as check_folder_writable
from .atomic_files import check_only_results as check_only_results
from .atomic_files import check_replaceable as check_replaceable
from .atomic_files import check_writable as check_writable
from .atomic_files import format_of as format_of
from .atomic_files import lock_folder as lock_folder
from .atomic_files import name_path_in_errors as name_path_in_errors
from .atomic_files import remove_leftover_folders as remove_leftover_folders
from .atomic_files import replace as replace
from .atomic_files import sync as sync
from .atomic_files import whole_file as whole_file
from .atomic_files import whole_files as whole_files
from .atomic_files import whole_folder as whole_folder
from .colours_of_figures import COLOURS as COLOURS
from .kept_inputs import find_network_file as find_network_file
from .kept_inputs import refuse_replacing as refuse_replacing
from .quoted_text import join_names as join_names
from .quoted_text import label_with_unit as label_with_unit
from .quoted_text import quote_for_cell as quote_for_cell
from .quoted_text import quote_for_figure as quote_for_figure
from .quoted_text import quote_for_file as quote_for_file
from .quoted_text import unquote_cell as unquote_cell
from .quoted_text import unquote_file as unquote_file
from .quoted_text import visible as visible
