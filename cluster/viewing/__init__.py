"""The live viewer in the browser: what is shown of a store or a scan, and its drawing and controls by viser."""
