"""docs/files.md, from the tables that files are written from and read by.

python docs/make/files_page.py
"""

from pathlib import Path

from gmem_jax.files.schemas import schema_page

if __name__ == "__main__":
    Path(__file__).parents[1].joinpath("files.md").write_text(schema_page())
