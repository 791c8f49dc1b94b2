"""The paper's two tests, run again and judged by error against truth: tables, figures, and which claims hold."""

from aemd.paper.figures import draw_figures
from aemd.paper.report import as_mapping, as_text
from aemd.paper.run import PaperResult, run_paper

__all__ = ["PaperResult", "as_mapping", "as_text", "draw_figures", "run_paper"]
