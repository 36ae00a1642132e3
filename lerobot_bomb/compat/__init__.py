"""Code that replaces functions of LeRobot, draccus or huggingface_hub; all of it is here.

`hooks` are for a user of our types; all but `hooks.paths` are installed on first use (`use`). `own` lasts as
long as one of our commands runs.
"""
