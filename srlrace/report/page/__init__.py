"""The report as one HTML page that needs nothing but itself."""

from srlrace.report.page.page import render_page

__all__ = ["render_page"]
