"""Code that reaches into LeRobot, draccus or huggingface_hub and replaces their functions; all of it is here.

`hooks` stand in them for a user of our types; but for `hooks.paths` none does before a first use (`use`).
`own` is for as long as one of our commands runs.
"""
