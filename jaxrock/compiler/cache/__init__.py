"""Compiled programs that are kept between sessions, and the keys that tell whether a function is the same as before.

Imports `jaxrock._core`. Start with `store`, then `key`.
"""

from jaxrock.compiler.cache.changes import watch as watch
from jaxrock.compiler.cache.enable import keep_compiled as keep_compiled
from jaxrock.compiler.cache.key import code_digest as code_digest, version_of as version_of
from jaxrock.compiler.cache.store import clear as clear, files as files, folder as folder, is_program as is_program
