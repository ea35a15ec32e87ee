"""Tables: columns of numbers and dates, in CSV or Parquet, whole or a block of rows at a time."""
