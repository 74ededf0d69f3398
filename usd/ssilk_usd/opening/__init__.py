# SPDX-License-Identifier: Apache-2.0
"""Open files safely: a path comes in, an open stage goes out.

`stage.open_stage` is the one way to open a file; read it first. `trial` reads in a process of its own before,
`memory` bounds what a file may take, and `specs` frees what USD keeps of closed layers. `garment_api` registers our
schema.
"""
