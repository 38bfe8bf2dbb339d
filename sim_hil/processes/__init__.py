"""Child processes that report to their parent in lines of JSON."""
