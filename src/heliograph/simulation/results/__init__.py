"""Results: records, statistics, tables, files and figures."""
