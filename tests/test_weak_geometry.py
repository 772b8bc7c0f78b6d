"""The study of degenerate motion: its judge, its solvers, and what it makes of rows."""

from __future__ import annotations

