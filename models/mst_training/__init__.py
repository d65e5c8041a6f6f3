"""The programs that trained the weights in `models/`: data generators, the training loop, and what is trained.

`mstfilter train completion` makes samples, trains the completion network and writes a folder that
`completer.weights=FOLDER` uses. Samples come from the package's own simulation; each follows from the seed. A run of
the filter needs nothing from here.

`mstfilter.base.resources.training_program("border")` imports a module of this package, from a checkout or a wheel.
"""
