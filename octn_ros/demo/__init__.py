"""The demo: the four nodes in one process, a client that works them over the graph, and a report of what came out."""
