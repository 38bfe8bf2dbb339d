"""What reports of every tool share: HTML pages, the style of plots, progress lines and TOML text."""
