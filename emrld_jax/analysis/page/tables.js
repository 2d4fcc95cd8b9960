// Tables that sort on a click. A column: {name, number, of(row) -> {text, sort, ..} or a text}.
function table(id, columns, rows, options = {}) {
  const body = el("tbody", {});
  const heads = columns.map((column, k) => {
    const sort = column.of ? el("button", { type: "button", onclick: () => order(k) },
      column.name) : column.name;
    return el("th", { class: classOf(column), scope: "col" }, sort);
  });
  const lines = rows.map((row) => {
    const cells = columns.map((column) => {
      const value = column.of(row);
      return value !== null && typeof value === "object" ? value : { text: value, sort: value };
    });
    const node = el("tr", {}, cells.map((cell, k) => el("td", {
      class: classOf(columns[k], cell.class),
      color: cell.color || "inherit",
    }, cell.node || cell.text)));
    return { node, cells };
  });
  let current = null, down = false;
  function order(k) {
    // numbers begin with the largest, texts with the first
    down = current === k ? !down : Boolean(columns[k].number);
    current = k;
    heads.forEach((head, j) => {
      if (j === k) head.setAttribute("aria-sort", down ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    });
    lines.sort((a, b) => compare(a.cells[k].sort, b.cells[k].sort, down));
    body.replaceChildren(...lines.map((line) => line.node));
  }
  body.append(...lines.map((line) => line.node));
  return el("div", { class: "box" }, el("table", { id, class: options.class || null },
    el("thead", {}, el("tr", {}, heads)), body));
}
function classOf(column, more) {
  return [column.number ? "number" : "", column.class, more].filter(Boolean).join(" ") || null;
}
function compare(a, b, down) {
  const none = (value) => value === null || value === undefined;
  if (none(a) || none(b)) return Number(none(a)) - Number(none(b));  // those without come last
  const sign = typeof a === "number" && typeof b === "number" ? a - b
    : String(a).localeCompare(String(b), "en", { numeric: true });
  return down ? -sign : sign;
}

// what a bar shows, on held-out tasks if there are any: the return after adaptation, and that of
// the demonstrations
function inBar(group) {
  const split = group.cells["test/return/after"] ? "test" : "train";
  return { cell: group.cells[`${split}/return/after`], shown: group.demonstrated[split] };
}
function resultTable() {
  const ends = {};  // of each problem: those of its bars
  for (const group of DATA.groups) {
    const { cell, shown } = inBar(group);
    const values = [cell.low, cell.value, cell.high, shown].map((x) => x || 0);
    const name = problemOf(group), [low, high] = ends[name] || [0, 1e-9];
    ends[name] = [Math.min(low, ...values), Math.max(high, ...values)];
  }
  const figure = (split, measure, when) => ({
    name: `${measure} ${when}, ${split === "test" ? "held\u2011out" : "training"}`, number: true,
    of: (group) => {
      const cell = group.cells[`${split}/${measure}/${when}`];
      if (!cell) return { text: "\u2013", sort: null };
      const form = formOf(measure), words = withInterval(cell, form);
      const value = form(cell.value), rest = words.slice(value.length);
      const few = cell.seeds === group.seeds.length ? null : ` (${seedsText(cell.seeds)})`;
      return { sort: cell.value, node: el("span", {}, value,
        [rest, few].map((line) => line && el("span", { class: "interval" }, line))) };
    },
  });
  return table("results", [
    { name: "algorithm", class: "name",
      of: (group) => ({ node: el("span", {}, group.label, el("span", { class: "sub" },
        problemOf(group))), sort: group.label, color: colorOf(group.label) }) },
    { name: "environment, demonstrations", class: "problem",
      of: (group) => ({ node: el("span", {}, group.environment, el("span", { class: "second" },
        ` ${group.demonstrations}`)), sort: problemOf(group) }) },
    { name: "seeds", number: true, of: (group) => group.seeds.length },
    figure("test", "return", "after"),
    { name: "beside the demon\u00adstrations\u2019 return", of: (group) => {
      const [low, high] = ends[problemOf(group)], { cell, shown } = inBar(group);
      return { node: el("span", {}, bar(group, low, high), el("span", { class: "second" },
        isNumber(shown) ? shown.toFixed(1) : "\u2013")), sort: (cell.value - low) / (high - low) };
    } },
    figure("test", "success", "after"),
    figure("train", "return", "after"), figure("train", "success", "after"),
    figure("test", "return", "before"),
    { name: "environ\u00adment steps", number: true,
      of: (group) => ({ sort: group.envSteps, node: el("span", {}, short(group.envSteps),
        el("span", { class: "second" }, ` ${group.iterations} iterations`)) }) },
    { name: "training took", number: true,
      of: (group) => ({ text: duration(group.seconds), sort: group.seconds }) },
  ], DATA.groups, { class: "pinned narrow" });
}
function bar(group, low, high) {
  const width = 100, x = scale(low, high, 6, width - 6), { cell, shown } = inBar(group);
  const node = svg("svg", { class: "bar", width, height: 20, color: colorOf(group.label), "aria-hidden": "true" },
    svg("line", { class: "rule", x1: x(low), x2: x(high), y1: 10, y2: 10 }));
  if (isNumber(shown)) node.append(svg("line", { class: "reference", x1: x(shown), x2: x(shown),
    y1: 2, y2: 18 }));
  if (cell.low !== null) node.append(svg("line", { class: "whisker", x1: x(cell.low),
    x2: x(cell.high), y1: 10, y2: 10 }));
  node.append(svg("circle", { class: "dot", cx: x(cell.value), cy: 10, r: 4.5 }));
  return node;
}

function settingsTable(onlyDiffering) {
  const rows = DATA.settings.filter((row) => row.differs || !onlyDiffering);
  if (!rows.length) return el("p", { class: "quiet" }, "All lines have the same settings.");
  const columns = DATA.groups.map((group, k) => ({
    name: `${group.environment}, ${group.demonstrations}: ${group.label}`,
    of: (row) => {
      const text = row.values[k] === null ? "(not a setting then)" : row.values[k];
      return { text, sort: text, class: row.values[k] === usual(row) ? "" : "unlike" };
    },
  }));
  return table("setting-values", [{ name: "setting", of: (row) => row.name }, ...columns], rows,
    { class: "pinned" });
}
function usual(row) {  // the value that most lines have, the first of those
  const counts = new Map();
  for (const value of row.values) counts.set(value, (counts.get(value) || 0) + 1);
  const most = Math.max(...counts.values());
  return row.values.find((value) => counts.get(value) === most);
}

function runTable() {
  const group = (run) => DATA.groups[run.group];
  return table("run-list", [
    { name: "algorithm", class: "name", of: (run) => ({ text: group(run).label,
      sort: group(run).label, color: colorOf(group(run).label) }) },
    { name: "environment", of: (run) => group(run).environment },
    { name: "demonstrations", of: (run) => group(run).demonstrations },
    { name: "seed", number: true, of: (run) => run.seed },
    { name: "commit", of: (run) => ({ node: el("code", {}, run.commits.join(", ")),
      sort: run.commits.join() }) },
    { name: "began", class: "whole", of: (run) => run.time.slice(0, 16).replace("T", " ") },
    { name: "resumed", number: true, of: (run) => run.resumed },
    { name: "training took", number: true,
      of: (run) => ({ text: duration(run.seconds), sort: run.seconds }) },
    { name: "folder", class: "whole", of: (run) => ({ node: el("code", {}, run.path),
      sort: run.path }) },
    { name: "files", class: "whole", of: (run) => ({ sort: run.files.length,
      node: el("span", {}, run.files.flatMap((file) => [
        el("a", { href: file.link }, file.name), " "])) }) },
  ], DATA.runs, { class: "pinned" });
}
function howRun() {
  const each = (words, values) => [el("dt", {}, words),
    [...new Set(values)].map((value) => el("dd", {}, el("code", {}, value)))];
  return el("div", { class: "how" }, DATA.groups.map((group, k) => {
    const runs = DATA.runs.filter((run) => run.group === k);
    return el("details", {}, el("summary", {}, `${problemOf(group)}: ${group.label}`),
      el("dl", {}, each("commands", runs.map((run) => run.command)),
        each("commits", group.commits), each("machines", runs.map((run) => run.machine)),
        each("versions", runs.map((run) => run.versions))));
  }));
}
