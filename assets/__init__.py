"""Designs, studies, materials and sources that ship with the twin.

Data only: `designs/*.toml` (one sensor each, a source beside every value), `studies/*.toml` (corpora) and
`references.bib` (the papers that comments cite by key). It is a package so that an installed wheel carries
the files; read them with `importlib.resources.files("assets")`.
"""
