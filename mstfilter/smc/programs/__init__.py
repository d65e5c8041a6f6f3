"""Probabilistic programs: a model is a Python function that calls `sample` and `observe`.

>>> from mstfilter.smc import Normal, Program, observe, sample
>>> def ar1(previous, y):
...     x = sample("x", Normal(0.0, 1.0) if previous is None else Normal(0.9 * previous["x"], 0.5))
...     observe("y", Normal(x, 1.0), y)
>>> state, infos = Program(ar1).bootstrap(n=1000).run([0.3, -0.1, 0.8], seed=0)
>>> state.population.particles["x"].shape
(1000,)

The function runs once per step for all particles. `previous` is a mapping from names to arrays with one row per
particle, None at the first step. The new particles are such a mapping, too: an array for each `sample`, and for each
entry of a mapping that the function returns. `observe` adds log p(value) to the log weights; None is a missing value
and adds nothing. ``switch(name, probs, branches, ...)`` draws a branch for each particle and runs each branch on its
particles. Particles that differ in the number of their variables are objects: see `StateSpaceModel`.

The methods of `Program` make a bootstrap and a guided filter from the function; the latter needs a guide program that
has the same sites. `sample` and `observe` happen in one pass, so a program is a Transition that weights its
particles; the filter has no Update.
"""
