"""Names that other folders take; the package loads them when first used."""

from .palette import COLOURS as COLOURS
from .quoting import join_names as join_names
from .quoting import label_with_unit as label_with_unit
from .quoting import quote_for_cell as quote_for_cell
from .quoting import quote_for_figure as quote_for_figure
from .quoting import quote_for_file as quote_for_file
from .quoting import unquote_cell as unquote_cell
from .quoting import unquote_file as unquote_file
from .quoting import visible as visible
from .whole_file import FORMATS as FORMATS
from .whole_file import check_folder_writable as check_folder_writable
from .whole_file import check_replaceable as check_replaceable
from .whole_file import check_writable as check_writable
from .whole_file import format_of as format_of
from .whole_file import lock_folder as lock_folder
from .whole_file import name_path_in_errors as name_path_in_errors
from .whole_file import remove_leftover_folders as remove_leftover_folders
from .whole_file import replace as replace
from .whole_file import sync as sync
from .whole_file import whole_files as whole_files
from .whole_file import whole_folder as whole_folder
