"""The same as in glTF as Universal Scene Description (USD); the only room that knows Pixar's library."""

from osfcore.extras import need

need("usd", "A USD file")
