"""The demo's report: acceptance checks, figures and numbers from the files of one run."""
