"""What all rooms share: errors, checks of fields and results, files, processes, and the registry of components.

Nothing here knows about particles or images.

============  =========================================================================================
`errors`      `InputError`: a fact, and hints what to do
`fields`      bounds of the fields of a component, checked when it is made
`results`     checks of what the methods of a component return
`registry`    components by name, and components from a configuration
`reading`     files of unknown origin, read safely
`files`       files that are complete or absent
`user_files`  Python files of the user, loaded as ``./file.py:Name``
`code`        hashes of Python code, by which results are known to be of the same program
`processes`   processes and threads
`lazy`        names that are imported when they are first used
`resources`   the presets, weights and examples that belong to the package
`trained`     trained networks in folders
============  =========================================================================================
"""
