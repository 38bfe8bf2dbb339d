"""HTML pages, plot style and progress display of all reports."""
