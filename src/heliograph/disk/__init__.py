"""Files and folders that appear whole or not at all, and names quoted for where they land."""
