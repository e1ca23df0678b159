"""Lowering: a step of a run as a scalar program, and that program as C.

    from_jaxpr, rules, structure    a jaxpr taken apart into numbers
    functions                       its inner functions, read once and called if they are long
    program, identities, passes     what comes of it, simplified
    operations                      what a program may hold, one row each
    packed                          the arrays that go in and out
    layout, emit_c, c/              its text in C, for CPUs and GPUs
    toolchain, nvrtc                compilers, and what they have built before

What runs such programs is in `engine`.
"""
