"""Neural fields on CUDA devices: Triton kernels, and tiny-cuda-nn where a user has it.

Nothing is imported here: Triton loads, and compiles, only when a model is first run by this back end.
"""
