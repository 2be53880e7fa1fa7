"""The report of a run as one HTML page: results, curves, statistics, and clouds that turn under the mouse.

`write_report` of `report` assembles it; each other module makes one kind of content, and `page` alone knows HTML.
"""
