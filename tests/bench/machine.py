"""Which machine a figure was measured on."""

import os
import platform
from datetime import date
from pathlib import Path


def machine() -> str:
    """Processor, cores, Python and date, in one line."""
    model = platform.processor() or "unknown processor"
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            model = line.split(":")[1].strip()
            break
    return f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}, {date.today().isoformat()}"
