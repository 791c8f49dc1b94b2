"""Tables in and out: a CSV log or a foreign MCAP file becomes a recording, a recording becomes CSV or Parquet."""

from aemd.tables.columns import Columns, read_columns
from aemd.tables.foreign import import_mcap
from aemd.tables.read import ImportSummary, import_csv
from aemd.tables.write import ExportSummary, export

__all__ = ["Columns", "ExportSummary", "ImportSummary", "export", "import_csv", "import_mcap", "read_columns"]
