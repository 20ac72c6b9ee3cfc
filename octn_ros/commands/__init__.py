"""The subcommands of `octn`: each module holds one, as a frozen dataclass of its arguments with `run()`.

Nothing heavy is imported here or in `octn_ros.cli`; a command imports what it needs when it runs.
"""
