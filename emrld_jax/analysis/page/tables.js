// Tables that sort on a click. A column: {name, number, of(row) -> {text, sort, ..} or a text}.
function table(id, columns, rows, options = {}) {
  const body = el("tbody", {});
  const heads = columns.map((column, k) => {
    const sort = column.of ? el("button", { type: "button", onclick: () => order(k) },
      column.name) : column.name;
    return el("th", { class: column.number ? "number" : null, scope: "col" }, sort);
  });
  const lines = rows.map((row) => {
    const cells = columns.map((column) => {
      const value = column.of(row);
      return value !== null && typeof value === "object" ? value : { text: value, sort: value };
    });
    const node = el("tr", {}, cells.map((cell, k) => el("td", {
      class: [columns[k].number ? "number" : "", columns[k].class || ""].join(" ").trim() || null,
      color: cell.color || "inherit",
    }, cell.node || cell.text)));
    if (options.line) options.line(node, row);
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
function compare(a, b, down) {
  const none = (value) => value === null || value === undefined;
  if (none(a) || none(b)) return Number(none(a)) - Number(none(b));  // those without come last
  const sign = typeof a === "number" && typeof b === "number" ? a - b
    : String(a).localeCompare(String(b), "en", { numeric: true });
  return down ? -sign : sign;
}

function resultTable() {
  const highest = {};  // of each problem: the end of its bars
  for (const group of DATA.groups) {
    const ends = ["train", "test"].flatMap((split) => {
      const cell = group.cells[`${split}/return/after`];
      return [cell ? cell.high || cell.value : 0, group.demonstrated[split] || 0];
    });
    const name = problemOf(group);
    highest[name] = Math.max(highest[name] || 1e-9, ...ends);
  }
  const figure = (split, measure, when) => ({
    name: `${measure} ${when}, ${split === "test" ? "held-out" : "training"}`, number: true,
    of: (group) => {
      const cell = group.cells[`${split}/${measure}/${when}`];
      if (!cell) return { text: "\u2013", sort: null };
      const form = formOf(measure), words = withInterval(cell, form);
      const value = form(cell.value), rest = words.slice(value.length);
      const few = cell.seeds === group.seeds.length ? "" : ` (${seedsText(cell.seeds)})`;
      return { sort: cell.value, node: el("span", {}, value,
        el("span", { class: "interval" }, rest + few)) };
    },
  });
  return table("results", [
    { name: "algorithm", class: "name",
      of: (group) => ({ text: group.label, sort: group.label, color: colorOf(group.label) }) },
    { name: "environment", of: (group) => group.environment },
    { name: "demonstrations", of: (group) => group.demonstrations },
    { name: "seeds", number: true, of: (group) => group.seeds.length },
    { name: "held-out return", of: (group) => ({ node: bar(group, highest[problemOf(group)]),
      sort: (group.cells["test/return/after"] || {}).value }) },
    figure("test", "return", "after"), figure("test", "success", "after"),
    figure("train", "return", "after"), figure("train", "success", "after"),
    figure("test", "return", "before"),
    { name: "demonstrations' return", number: true, of: (group) => {
      const value = group.demonstrated.test === undefined ? group.demonstrated.train
        : group.demonstrated.test;
      return { text: value === null ? "\u2013" : value.toFixed(1), sort: value };
    } },
    { name: "meta-iterations", number: true, of: (group) => group.iterations },
    { name: "environment steps", number: true,
      of: (group) => ({ text: short(group.envSteps), sort: group.envSteps }) },
    { name: "training took", number: true,
      of: (group) => ({ text: duration(group.seconds), sort: group.seconds }) },
  ], DATA.groups, { class: "pinned" });
}
function bar(group, highest) {
  const cell = group.cells["test/return/after"] || group.cells["train/return/after"];
  const width = 150, x = scale(0, highest, 6, width - 6);
  const clip = (value) => Math.min(width - 4, Math.max(4, x(value)));
  const node = svg("svg", { width, height: 20, color: colorOf(group.label), "aria-hidden": "true" },
    svg("line", { class: "rule", x1: x(0), x2: x(highest), y1: 10, y2: 10 }));
  const shown = group.demonstrated.test || group.demonstrated.train;
  if (shown) node.append(svg("line", { class: "reference", x1: clip(shown), x2: clip(shown), y1: 2,
    y2: 18 }));
  if (cell && cell.low !== null) node.append(svg("line", { class: "whisker", x1: clip(cell.low),
    x2: clip(cell.high), y1: 10, y2: 10 }));
  if (cell) node.append(svg("circle", { class: "dot", cx: clip(cell.value), cy: 10, r: 4.5 }));
  return node;
}

function settingsTable(onlyDiffering) {
  const rows = DATA.settings.filter((row) => row.differs || !onlyDiffering);
  if (!rows.length) return el("p", { class: "quiet" }, "All lines have the same settings.");
  const columns = DATA.groups.map((group, k) => ({
    name: `${group.environment}, ${group.demonstrations}: ${group.label}`,
    of: (row) => row.values[k] === null ? "(not a setting then)" : row.values[k],
  }));
  return table("setting-values", [{ name: "setting", of: (row) => row.name }, ...columns], rows,
    { class: "pinned", line: (node, row) => node.classList.toggle("differs", row.differs) });
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
    { name: "began", of: (run) => run.time.slice(0, 16).replace("T", " ") },
    { name: "resumed", number: true, of: (run) => run.resumed },
    { name: "training took", number: true,
      of: (run) => ({ text: duration(run.seconds), sort: run.seconds }) },
    { name: "files", class: "wide", of: (run) => ({ sort: run.path, node: el("span", {},
      el("code", {}, run.path), " ", run.files.flatMap((file) => [
        el("a", { href: file.link }, file.name), " "])) }) },
    { name: "command", class: "wide", of: (run) => ({ node: el("code", {}, run.command),
      sort: run.command }) },
    { name: "machine", class: "wide", of: (run) => run.machine },
    { name: "versions", class: "wide", of: (run) => run.versions },
  ], DATA.runs, { class: "pinned" });
}
