"""Styles of pages: light or dark, readable at any width, and on paper."""

from __future__ import annotations

QUICKLOOK_STYLE = """
:root { color-scheme: light dark; --ink: #1d242b; --muted: #5d6770; --paper: #fbfbf9; --card: #fff; --line: #d9dcd7;
  --good: #1d7a38; --bad: #b3261e; --note: #fff4d6; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e8e6; --muted: #a3abb1; --paper: #16191c; --card: #1f2428;
  --line: #384046; --good: #6fcf8a; --bad: #ff8a80; --note: #3a3115; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.25rem 4rem; max-width: 78rem; background: var(--paper); color: var(--ink);
  font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.7rem; margin: 0; } h2 { font-size: 1.15rem; margin: 2.4rem 0 .6rem; }
p { margin: .4rem 0; } .muted, figcaption, small { color: var(--muted); }
.figures { display: flex; flex-wrap: wrap; gap: .8rem; margin: 1.4rem 0; }
.figures div { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: .6rem .9rem;
  min-width: 9rem; }
.figures b { display: block; font-size: 1.35rem; font-variant-numeric: tabular-nums; }
.notes { background: var(--note); border-radius: 8px; padding: .6rem 1rem .6rem 2rem; margin: 1rem 0; }
figure { margin: 1.2rem 0; } figure img { width: 100%; height: auto; background: #fff; border: 1px solid var(--line);
  border-radius: 8px; display: block; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .28rem .8rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap;
  vertical-align: top; }
th { color: var(--muted); font-weight: 600; } th:first-child, td:first-child, .left { text-align: left; }
td.left { white-space: normal; min-width: 12rem; } .ok { color: var(--good); } .no { color: var(--bad); }
"""

REPORT_STYLE = """
:root { color-scheme: light; --ink: #1d242b; --muted: #5d6770; --paper: #fbfbf9; --card: #fff; --line: #d9dcd7;
  --good: #1d7a38; --care: #e0a100; --bad: #b3261e; --note: #fff4d6; --accent: #0b5e8a; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.25rem 4rem; max-width: 78rem; background: var(--paper); color: var(--ink);
  font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
header { border-bottom: 2px solid var(--accent); padding-bottom: .8rem; }
header .kind { color: var(--accent); font-weight: 600; letter-spacing: .04em; text-transform: uppercase;
  font-size: .8rem; margin: 0 0 .2rem; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0; }
h2 { font-size: 1.15rem; margin: 2.4rem 0 .6rem; } h3 { font-size: 1rem; margin: 1.2rem 0 .4rem; }
p { margin: .4rem 0; } .muted, figcaption { color: var(--muted); } h2 + p.muted { margin-top: -.3rem; }
.verdict { border-left: 6px solid; border-radius: 8px; background: var(--card); padding: .8rem 1.1rem; margin: 1.2rem 0;
  font-size: 1.1rem; } .verdict.good { border-color: var(--good); } .verdict.care { border-color: var(--care); }
.verdict.unusable { border-color: var(--bad); }
.figures { display: grid; grid-template-columns: repeat(auto-fill, minmax(9.4rem, 1fr)); gap: .8rem; margin: 1.4rem 0; }
.figures div { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: .6rem .9rem; }
.figures b { display: block; font-size: 1.35rem; font-variant-numeric: tabular-nums; }
.notes { background: var(--note); border-radius: 8px; padding: .6rem 1rem .6rem 2rem; margin: 1rem 0; }
figure { margin: .6rem 0 1.2rem; } figure img { width: 100%; height: auto; background: #fff;
  border: 1px solid var(--line); border-radius: 8px; display: block; padding: .5rem; }
figure.given img { max-height: 30rem; object-fit: contain; }
.scroll { overflow-x: auto; margin-bottom: .8rem; } .scroll + p.muted { margin-top: -.4rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .28rem .8rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap;
  vertical-align: top; }
th { color: var(--muted); font-weight: 600; } th:first-child, td:first-child, .left { text-align: left; }
td.left { white-space: normal; min-width: 12rem; } tr.held td { color: var(--muted); }
td.hash { font: 12.5px/1.6 ui-monospace, "DejaVu Sans Mono", monospace; white-space: normal; overflow-wrap: anywhere;
  text-align: left; }
.no { color: var(--bad); } code { font: 13px ui-monospace, "DejaVu Sans Mono", monospace; }
.method { max-width: 52rem; }
@media (max-width: 640px) { body { padding: 1rem .7rem 3rem; } h1 { font-size: 1.25rem; overflow-wrap: anywhere; }
  h2 { margin-top: 1.6rem; } .figures { gap: .5rem; grid-template-columns: 1fr 1fr; }
  .figures div { padding: .45rem .6rem; } .figures b { font-size: 1.1rem; }
  figure img { padding: .2rem; } th, td { padding: .28rem .45rem; } td.left { min-width: 11rem; }
  .stacked tr { display: block; border-bottom: 1px solid var(--line); padding: .3rem 0; }
  .stacked thead { display: none; }
  .stacked td { display: block; border: 0; text-align: left; padding: .1rem 0; white-space: normal; min-width: 0; }
  .stacked td + td[data-head]::before { content: attr(data-head) ": "; color: var(--muted); } }
@media print { body { padding: 0; max-width: none; background: #fff; font-size: 10.5pt; }
  h2, h3 { break-after: avoid; } figure, tr, .verdict, .figures div { break-inside: avoid; }
  figure img { border: 0; padding: 0; } .scroll { overflow: visible; } th, td { padding: .2rem .45rem; } }
@page { size: A4; margin: 15mm; }
"""
