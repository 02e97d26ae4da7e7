# MuJoCo's compiled modules list their names at run time only: type checkers see none of them.
from typing import Any

def __getattr__(name: str) -> Any: ...
