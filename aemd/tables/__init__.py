"""Tables in and out: a CSV log becomes a recording, a recording becomes CSV or Parquet."""

from aemd.tables.read import ImportSummary, import_csv
from aemd.tables.write import ExportSummary, export

__all__ = ["ExportSummary", "ImportSummary", "export", "import_csv"]
