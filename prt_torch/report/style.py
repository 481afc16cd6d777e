"""How the page looks and its one script: sorting the results table by a click on a heading."""

STYLE = """
:root { color-scheme: light dark;
  --page: #f5f6f8; --card: #ffffff; --ink: #1f2328; --muted: #626a75; --line: #e3e6ea;
  --accent: #2a6fc9; --warn: #8a5a00; --warn-back: #fdf3dd; --bad: #a8261d; --bad-back: #fdeceb;
  --good: #1b6e45; --good-back: #e6f5ed; }
@media (prefers-color-scheme: dark) { :root {
  --page: #101216; --card: #181b20; --ink: #e6e8eb; --muted: #9aa1ab; --line: #2c3138;
  --accent: #6ea8f0; --warn: #e9bd5f; --warn-back: #33290f; --bad: #f2938c; --bad-back: #3a1d1b;
  --good: #6fcf9d; --good-back: #16301f; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink);
  font: 15px/1.55 system-ui, -apple-system, "Segoe UI", "Helvetica Neue", sans-serif; }
main { max-width: 1240px; margin: 0 auto; padding: 36px 24px 80px; }
h1 { font-size: 27px; line-height: 1.2; margin: 0 0 4px; letter-spacing: -0.01em;
  overflow-wrap: anywhere; }
h2 { font-size: 18px; margin: 44px 0 12px; }
h3 { font-size: 15px; margin: 24px 0 10px; }
p { margin: 0 0 12px; max-width: 75ch; }
.lead, .note, figcaption, dt { color: var(--muted); }
.note { font-size: 13px; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 10px; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(210px, 1fr)); gap: 12px;
  margin: 22px 0 12px; }
.tile { padding: 14px 16px; }
.tile .label { color: var(--muted); font-size: 13px; }
.tile .value { font-size: 25px; line-height: 1.3; font-weight: 600; letter-spacing: -0.01em; }
.tile .of { font-size: 13px; color: var(--muted); overflow-wrap: anywhere; }
.facts { display: grid; margin: 0 0 12px;
  grid-template-columns: repeat(auto-fit, minmax(250px, 1fr)); gap: 12px; }
.facts .card { padding: 14px 16px; }
.facts h3 { margin: 0 0 6px; }
dl { display: grid; grid-template-columns: auto 1fr; gap: 2px 16px; margin: 0; }
dd { margin: 0; text-align: right; font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
.warnings { margin: 0; padding: 10px 16px 10px 34px; border-radius: 10px;
  background: var(--warn-back); color: var(--warn); }
.scroll { overflow-x: auto; }
.scroll + .note { margin-top: 12px; }
table { border-collapse: collapse; width: 100%; font-size: 13.5px; }
th, td { padding: 7px 12px; text-align: right; white-space: nowrap;
  border-bottom: 1px solid var(--line); font-variant-numeric: tabular-nums; }
tbody tr:last-child td { border-bottom: 0; }
th { color: var(--muted); font-weight: 500; vertical-align: bottom; line-height: 1.3; }
th.text, td.text { text-align: left; }
td.wide { white-space: normal; min-width: 16ch; }
td.name { font-weight: 500; }
tbody tr:hover { background: color-mix(in srgb, var(--accent) 7%, transparent); }
th button { all: unset; cursor: pointer; white-space: pre-line; }
th button:hover, th button:focus-visible { color: var(--ink); text-decoration: underline; }
th[aria-sort=ascending] button::after { content: " ↑"; }
th[aria-sort=descending] button::after { content: " ↓"; }
.badge { display: inline-block; padding: 0 8px; border-radius: 99px; font-size: 12.5px; }
.badge.good { color: var(--good); background: var(--good-back); }
.badge.warn { color: var(--warn); background: var(--warn-back); }
.badge.bad { color: var(--bad); background: var(--bad-back); }
.plot { padding: 14px; margin: 0 0 12px; }
.plot img { display: block; width: 100%; height: auto; }
.pictures { display: grid; gap: 12px;
  grid-template-columns: repeat(auto-fill, minmax(330px, 1fr)); }
figure { margin: 0; overflow: hidden; }
.pictures img { display: block; width: 100%; height: auto; }
figcaption { padding: 9px 12px 11px; font-size: 13px; line-height: 1.4; overflow-wrap: anywhere; }
figcaption b { display: block; color: var(--ink); font-weight: 600; }
.scale { display: flex; align-items: center; gap: 8px; margin-top: 6px;
  font-variant-numeric: tabular-nums; }
.scale i { flex: 1; height: 8px; border-radius: 4px; }
@media print { body { background: none; } .card { break-inside: avoid; } }
"""

SORTING = """
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => {
    const heading = button.parentElement, table = heading.closest("table");
    const column = [...heading.parentElement.children].indexOf(heading);
    const down = heading.getAttribute("aria-sort") === "ascending";
    for (const other of table.querySelectorAll("th")) other.removeAttribute("aria-sort");
    heading.setAttribute("aria-sort", down ? "descending" : "ascending");
    const key = (row) => row.children[column].dataset.value;
    const compare = (a, b) => {
      const x = key(a), y = key(b);
      if (x === "" || y === "") return (x === "") - (y === "");  // missing values stay last
      const order = heading.classList.contains("text") ? x.localeCompare(y) : x - y;
      return down ? -order : order;
    };
    const body = table.tBodies[0];
    body.append(...[...body.rows].sort(compare));
  });
}
"""
