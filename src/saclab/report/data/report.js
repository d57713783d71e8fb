"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const COLOURS = 7;
  const SHAPES = [
    "M0-4a4 4 0 1 0 .01 0z", "M-3.6-3.6h7.2v7.2h-7.2z", "M0-4.6L4.4 3.4h-8.8z", "M0-5L4.4 0 0 5-4.4 0z",
    "M0 4.6L4.4-3.4h-8.8z", "M-1.5-4.5h3v3h3v3h-3v3h-3v-3h-3v-3h3z",
    "M-4-2.2L-2.2-4 0-1.8 2.2-4 4-2.2 1.8 0 4 2.2 2.2 4 0 1.8-2.2 4-4 2.2-1.8 0z",
    "M0-5L1.3-1.6 4.9-1.5 2 .7 3 4.2 0 2.1-3 4.2-2 .7-4.9-1.5-1.3-1.6z",
  ];
  const seeds = [...new Set(data.environments.flatMap((environment) => environment.panels.flatMap(
    (panel) => panel.arms.flatMap((arm) => arm.runs.map((run) => run.seed)))))].sort((a, b) => a - b);
  const state = { axis: data.axis, arms: new Set(data.arms.keys()), seeds: new Set(seeds), runs: true, bands: true, paper: true };

  // Elements are built node by node: text from run folders never becomes markup.
  const make = (space, name, attributes, children) => {
    const node = space ? document.createElementNS(space, name) : document.createElement(name);
    for (const [key, value] of Object.entries(attributes || {})) node.setAttribute(key, value);
    node.append(...(children || []));
    return node;
  };
  const html = (name, attributes, ...children) => make(null, name, attributes, children);
  const svg = (name, attributes, ...children) => make("http://www.w3.org/2000/svg", name, attributes, children);
  const colour = (arm) => (arm === null || arm === undefined ? "a-none" : `a${arm % COLOURS}`);
  const shape = (arm) => SHAPES[arm % SHAPES.length];

  const short = (value) => {
    const size = Math.abs(value);
    if (size >= 1e6) return `${+(value / 1e6).toPrecision(3)}M`;
    if (size >= 1e4) return `${+(value / 1e3).toPrecision(3)}k`;
    return `${+value.toPrecision(3)}`;
  };
  const exact = (value) => (value === null || value === undefined ? "–" : Math.abs(value) >= 100
    ? Math.round(value).toLocaleString("en") : `${+value.toPrecision(3)}`);

  function ticks(low, high, count) {
    const rough = (high - low) / Math.max(1, count), power = 10 ** Math.floor(Math.log10(rough));
    const away = (factor) => Math.abs(Math.log((factor * power) / rough));
    const step = power * [1, 2, 2.5, 5, 10].reduce((a, b) => (away(b) < away(a) ? b : a));
    const values = [];
    for (let i = Math.ceil(low / step); i * step <= high; i += 1) values.push(+(i * step).toPrecision(12));
    return values;
  }

  function extent(arrays) {
    let low = Infinity, high = -Infinity;
    for (const values of arrays) for (const value of values) {
      if (value === null) continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
    if (low > high) return null;
    if (low === high) { const room = Math.abs(low) * 0.1 || 1; return [low - room, high + room]; }
    return [low, high];
  }

  function path(x, y, scaleX, scaleY) {
    let text = "", open = false;
    for (let i = 0; i < y.length; i += 1) {
      if (y[i] === null || x[i] === null) { open = false; continue; }
      const px = scaleX(x[i]).toFixed(1), py = scaleY(y[i]).toFixed(1);
      text += `${open ? "L" : "M"}${px} ${py}`;
      open = true;
    }
    return text;
  }

  function bandPath(x, low, high, scaleX, scaleY) {
    const forth = path(x, low, scaleX, scaleY), back = path([...x].reverse(), [...high].reverse(), scaleX, scaleY);
    return forth && back ? `${forth}L${back.slice(1)}Z` : "";
  }

  function nearest(x, target) {
    let best = 0;
    for (let i = 1; i < x.length; i += 1) if (Math.abs(x[i] - target) < Math.abs(x[best] - target)) best = i;
    return best;
  }

  function axes(width, height, box, rangeX, rangeY, titleX) {
    const scaleX = (value) => box.left + ((value - rangeX[0]) / (rangeX[1] - rangeX[0])) * (width - box.left - box.right);
    const scaleY = (value) => height - box.bottom - ((value - rangeY[0]) / (rangeY[1] - rangeY[0])) * (height - box.top - box.bottom);
    const group = svg("g", { "aria-hidden": "true" });
    for (const value of ticks(...rangeY, 5)) {
      group.append(svg("line", { class: "grid", x1: box.left, x2: width - box.right, y1: scaleY(value), y2: scaleY(value) }),
        svg("text", { x: box.left - 6, y: scaleY(value) + 4, "text-anchor": "end" }, short(value)));
    }
    for (const value of ticks(...rangeX, width / 70)) {
      group.append(svg("line", { class: "grid", x1: scaleX(value), x2: scaleX(value), y1: height - box.bottom, y2: height - box.bottom + 4 }),
        svg("text", { x: scaleX(value), y: height - box.bottom + 16, "text-anchor": "middle" }, short(value)));
    }
    group.append(svg("text", { x: (box.left + width - box.right) / 2, y: height - 4, "text-anchor": "middle" }, titleX));
    return { scaleX, scaleY, group };
  }

  /* A chart of lines. `arms`: [{arm, count, x, middle, low, high, runs: [{seed, x, y}]}], `paper`: [{title, arm, x, y}]. */
  function lineChart(figure, chart) {
    const width = Math.max(260, figure.clientWidth - 20), height = Math.round(Math.min(300, Math.max(210, width * 0.62)));
    const box = { left: 48, right: 18, top: 8, bottom: 36 };
    const lines = chart.arms.flatMap((arm) => [[arm.x, arm.middle], ...arm.runs.map((run) => [run.x, run.y])]);
    const rangeX = extent(lines.map((line) => line[0]));
    const paper = rangeX ? chart.paper.map((line) => {
      const kept = line.x.map((x, i) => i).filter((i) => line.x[i] <= rangeX[1]);
      return { ...line, x: kept.map((i) => line.x[i]), y: kept.map((i) => line.y[i]) };
    }) : [];
    const rangeY = extent([...lines.map((line) => line[1]), ...paper.map((line) => line.y),
      ...chart.arms.flatMap((arm) => (arm.low ? [arm.low, arm.high] : []))]);
    figure.querySelectorAll("svg, .readout, .empty").forEach((node) => node.remove());
    if (!rangeX || !rangeY) { figure.append(html("p", { class: "empty note" }, "Nothing to show.")); return; }

    const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${chart.title} over ${chart.titleX}` });
    const { scaleX, scaleY, group } = axes(width, height, box, rangeX, rangeY, chart.titleX);
    picture.append(group);
    for (const arm of chart.arms) {
      if (arm.low) picture.append(svg("path", { class: `band ${colour(arm.arm)}`, d: bandPath(arm.x, arm.low, arm.high, scaleX, scaleY) }));
      for (const run of arm.runs) picture.append(svg("path", { class: `run ${colour(arm.arm)}`, d: path(run.x, run.y, scaleX, scaleY) }));
    }
    for (const line of paper) picture.append(svg("path", { class: `paper ${colour(line.arm)}`, d: path(line.x, line.y, scaleX, scaleY) }));
    for (const arm of chart.arms) {
      picture.append(svg("path", { class: `middle ${colour(arm.arm)}`, d: path(arm.x, arm.middle, scaleX, scaleY) }));
      const every = Math.max(1, Math.floor(arm.x.length / 7));
      for (let i = Math.min(arm.x.length - 1, arm.arm * Math.max(1, Math.floor(every / 4))); i < arm.x.length; i += every) {
        if (arm.middle[i] !== null) picture.append(svg("path", { class: `marker ${colour(arm.arm)}`, d: shape(arm.arm),
          transform: `translate(${scaleX(arm.x[i]).toFixed(1)} ${scaleY(arm.middle[i]).toFixed(1)})` }));
      }
    }
    const cursor = svg("line", { class: "cursor", y1: box.top, y2: height - box.bottom, visibility: "hidden" });
    const readout = html("div", { class: "readout", role: "status" });
    picture.append(cursor);
    figure.append(picture, readout);
    pointing(figure, { ...chart, paper }, picture, cursor, readout, { width, height, box, rangeX, scaleX, scaleY });
  }

  /* Hover, touch and arrow keys move a cursor; the values there are read out. */
  function pointing(figure, chart, picture, cursor, readout, frame) {
    const show = (target, pointerY) => {
      const x = frame.scaleX(target);
      cursor.setAttribute("x1", x); cursor.setAttribute("x2", x); cursor.setAttribute("visibility", "visible");
      readout.className = `readout ${x > frame.width / 2 ? "left" : "right"}`;
      readout.replaceChildren(html("b", {}, `${exact(target)} ${chart.titleX}`));
      for (const arm of chart.arms) {
        if (!arm.x.length || target > arm.x[arm.x.length - 1] * 1.02) continue;
        const i = nearest(arm.x, target);
        const interval = arm.low ? ` [${exact(arm.low[i])}, ${exact(arm.high[i])}]` : "";
        const entry = html("div", { class: colour(arm.arm) }, `${data.arms[arm.arm].title}: ${exact(arm.middle[i])}${interval}, n\u00a0=\u00a0${arm.count}`);
        readout.append(entry);
      }
      for (const line of chart.paper) {
        if (!line.x.length || target < line.x[0] * 0.98 || target > line.x[line.x.length - 1] * 1.02) continue;
        readout.append(html("div", { class: colour(line.arm) }, `${line.title}: ${exact(line.y[nearest(line.x, target)])}`));
      }
      let closest = null;
      for (const arm of chart.arms) for (const run of arm.runs) {
        if (pointerY === undefined || !run.x.length) continue;
        const i = nearest(run.x, target), gap = Math.abs(frame.scaleY(run.y[i]) - pointerY);
        if (gap < 12 && (!closest || gap < closest.gap)) closest = { gap, text: `${data.arms[arm.arm].title}, seed ${run.seed}: ${exact(run.y[i])}` };
      }
      if (closest) readout.append(html("div", {}, `single run: ${closest.text}`));
    };
    const hide = () => { cursor.setAttribute("visibility", "hidden"); readout.replaceChildren(); };
    const steps = chart.arms.length ? chart.arms.reduce((a, b) => (a.x.length >= b.x.length ? a : b)).x : [];
    let position = -1;
    picture.addEventListener("pointermove", (event) => {
      const bounds = picture.getBoundingClientRect(), ratio = frame.width / bounds.width;
      const px = (event.clientX - bounds.left) * ratio, inner = frame.width - frame.box.left - frame.box.right;
      const share = Math.min(1, Math.max(0, (px - frame.box.left) / inner));
      const target = frame.rangeX[0] + share * (frame.rangeX[1] - frame.rangeX[0]);
      position = nearest(steps, target);
      if (steps.length) show(steps[position], (event.clientY - bounds.top) * ratio);
    });
    picture.addEventListener("pointerleave", hide);
    figure.onblur = hide;
    figure.onkeydown = (event) => {
      const moves = { ArrowRight: 1, ArrowLeft: -1, PageDown: 10, PageUp: -10, Home: -Infinity, End: Infinity };
      if (event.key === "Escape") { hide(); return; }
      if (!(event.key in moves) || !steps.length) return;
      event.preventDefault();
      position = Math.min(steps.length - 1, Math.max(0, position + moves[event.key]));
      show(steps[position]);
    };
  }

  /* One row per arm: a point, its interval as a bar, its runs as ticks, the paper's number as a diamond. */
  function intervalChart(figure, chart) {
    const rows = chart.rows.filter((row) => state.arms.has(row.arm));
    figure.querySelectorAll(".row, svg, .empty").forEach((node) => node.remove());
    const known = rows.map((row) => [row.estimate, row.low, row.high, row.paper, ...row.runs].filter((value) => value !== null && value !== undefined));
    const range = extent(known);
    if (!range) { figure.append(html("p", { class: "empty note" }, "Nothing to show.")); return; }
    const width = Math.max(260, figure.clientWidth - 20), room = (range[1] - range[0]) * 0.04;
    const scale = (value) => 12 + ((value - range[0] + room) / (range[1] - range[0] + 2 * room)) * (width - 24);
    const marks = ticks(...range, width / 70);
    const strip = (height, ...nodes) => svg("svg", { viewBox: `0 0 ${width} ${height}`, "aria-hidden": "true" },
      ...marks.map((value) => svg("line", { class: "grid", x1: scale(value), x2: scale(value), y1: 0, y2: 22 })), ...nodes);
    for (const row of rows) {
      const nodes = [];
      if (row.low !== null) nodes.push(svg("line", { class: `bar ${colour(row.arm)}`, x1: scale(row.low), x2: scale(row.high), y1: 11, y2: 11 }));
      for (const run of row.runs) nodes.push(svg("line", { class: "tick", x1: scale(run), x2: scale(run), y1: 5, y2: 17 }));
      nodes.push(svg("path", { class: `marker ${colour(row.arm)}`, d: shape(row.arm), transform: `translate(${scale(row.estimate)} 11) scale(1.3)` }));
      if (row.paper !== null) nodes.push(svg("path", { class: "reference", d: SHAPES[3], transform: `translate(${scale(row.paper)} 11) scale(1.3)` }));
      const interval = row.low === null ? ", no interval" : ` [${exact(row.low)}, ${exact(row.high)}]`;
      const paper = row.paper === null ? "" : ` · ◇\u00a0paper\u00a0${exact(row.paper)}`;
      figure.append(html("div", { class: "row" }, `${data.arms[row.arm].title}: ${exact(row.estimate)}${interval}, n\u00a0=\u00a0${row.count}${paper}`), strip(22, ...nodes));
    }
    figure.append(strip(24, ...marks.map((value) => svg("text", { x: scale(value), y: 16, "text-anchor": "middle" }, short(value)))));
  }

  function panelChart(panel) {
    const onAxis = (x) => data.pool[x[state.axis]];
    const arms = panel.arms.filter((arm) => state.arms.has(arm.arm)).map((arm) => ({
      arm: arm.arm, count: arm.runs.length, x: onAxis(arm.x), middle: arm.middle,
      low: state.bands ? arm.low : null, high: arm.high,
      runs: state.runs && arm.runs.length > 1
        ? arm.runs.filter((run) => state.seeds.has(run.seed)).map((run) => ({ seed: run.seed, x: onAxis(run.x), y: run.y })) : [],
    }));
    const paper = state.paper ? panel.paper.filter((line) => state.axis in line.x && (line.arm === null || state.arms.has(line.arm)))
      .map((line) => ({ title: line.title, arm: line.arm, x: onAxis(line.x), y: line.y })) : [];
    return { title: panel.title, titleX: data.axes[state.axis], arms, paper };
  }

  function profileChart(profile) {
    // A share changes in steps: every point but the first comes twice, first with the value before it.
    const twice = (values) => values.flatMap((value) => [value, value]);
    const x = twice(profile.x).slice(1), steps = (values) => (values ? twice(values).slice(0, -1) : null);
    const arms = profile.arms.filter((arm) => state.arms.has(arm.arm)).map((arm) => ({
      arm: arm.arm, count: arm.count, x, middle: steps(arm.middle),
      low: state.bands ? steps(arm.low) : null, high: steps(arm.high), runs: [],
    }));
    return { title: "share of runs above a score", titleX: profile.title, arms, paper: [] };
  }

  const figures = [];
  function chartFigure(host, title, meaning, draw) {
    const caption = html("figcaption", {}, title);
    if (meaning) caption.append(html("small", {}, meaning));
    const figure = html("figure", { tabindex: "0", role: "group", "aria-label": `${title}. Arrow keys read the values.` }, caption);
    host.append(figure);
    figures.push(() => draw(figure));
  }

  for (const host of document.querySelectorAll("[data-draw]")) {
    const source = host.dataset.environment === "together" ? data.together : data.environments[Number(host.dataset.environment)];
    const kind = host.dataset.draw;
    if (source.panels && kind === "diagnostics" && !source.panels.some((panel) => panel.group === kind)) host.append("Nothing logged so far.");
    else if (kind === "profile") chartFigure(host, `by ${source.profile.title}`, "further right is better", (figure) => lineChart(figure, profileChart(source.profile)));
    else if (kind === "intervals") for (const chart of source.intervals) chartFigure(host, chart.title, "", (figure) => intervalChart(figure, chart));
    else for (const panel of source.panels) if (panel.group === kind) chartFigure(host, panel.title, panel.meaning, (figure) => lineChart(figure, panelChart(panel)));
  }
  const controls = document.getElementById("controls");
  const drawAll = () => {
    figures.forEach((draw) => draw());
    // What a link or the Tab key leads to must not end up under the controls where these stay in view.
    const covered = getComputedStyle(controls).position === "sticky" ? controls.offsetHeight : 0;
    document.documentElement.style.scrollPaddingTop = `${covered}px`;
  };

  function choice(type, name, title, checked, change, swatch) {
    const input = html("input", { type, name });
    input.checked = checked;
    input.addEventListener("change", () => { change(input.checked); drawAll(); });
    return html("label", {}, input, ...(swatch ? [swatch] : []), title);
  }
  const toggle = (set, value) => (on) => { if (on) set.add(value); else set.delete(value); };
  const swatch = (arm) => svg("svg", { viewBox: "0 0 30 14", "aria-hidden": "true" },
    svg("line", { class: `middle ${colour(arm)}`, x1: 0, x2: 30, y1: 7, y2: 7 }),
    svg("path", { class: `marker ${colour(arm)}`, d: shape(arm), transform: "translate(15 7)" }));
  const group = (title, ...choices) => html("fieldset", {}, html("legend", {}, title), ...choices);

  controls.append(
    group("Variants", ...data.arms.map((arm, i) => choice("checkbox", "arm", arm.title, true, toggle(state.arms, i), swatch(i)))),
    group("Over", ...Object.entries(data.axes).map(([key, title]) =>
      choice("radio", "axis", title, key === state.axis, () => { state.axis = key; }))),
    group("Show",
      choice("checkbox", "bands", "95 % bands", true, (on) => { state.bands = on; }),
      choice("checkbox", "paper", "the paper's curves", true, (on) => { state.paper = on; }),
      choice("checkbox", "runs", "single runs", true, (on) => { state.runs = on; })),
    html("details", {}, html("summary", {}, "Seeds"), html("fieldset", {},
      ...seeds.map((seed) => choice("checkbox", "seed", `${seed}`, true, toggle(state.seeds, seed))))));
  controls.addEventListener("submit", (event) => event.preventDefault());

  document.getElementById("copy").addEventListener("click", async (event) => {
    const commands = document.getElementById("commands");
    try { await navigator.clipboard.writeText(commands.textContent); event.target.textContent = "Copied"; } catch {
      getSelection().selectAllChildren(commands);
      event.target.textContent = "Selected: press Ctrl-C";
    }
  });
  addEventListener("beforeprint", () => document.querySelectorAll("main details").forEach((node) => { node.open = true; }));
  let width = document.body.clientWidth;
  addEventListener("resize", () => {
    if (document.body.clientWidth !== width) { width = document.body.clientWidth; drawAll(); }
  });
  drawAll();

  // A page that is served asks for a newer one, and keeps what its reader has chosen and has before their eyes.
  const version = document.documentElement.dataset.version;
  if (version) {
    const inputs = () => [...controls.querySelectorAll("input")].map((input) => [`${input.name}: ${input.parentNode.textContent}`, input]);
    const details = () => [...document.querySelectorAll("details")].map((node) => [node.querySelector("summary").textContent, node]);
    const landmarks = () => [...document.querySelectorAll("h2, figure")];
    const top = (node) => node.getBoundingClientRect().top;
    const kept = JSON.parse(sessionStorage.getItem("saclab") || "null");
    history.scrollRestoration = "manual"; // what browsers do by themselves differs, and what is above may have grown
    if (kept) {
      for (const [name, input] of inputs()) {
        if (name in kept.checked && input.checked !== kept.checked[name]) {
          input.checked = kept.checked[name];
          if (input.type === "checkbox" || input.checked) input.dispatchEvent(new Event("change"));
        }
      }
      for (const [name, node] of details()) node.open = kept.open.includes(name);
      const landmark = landmarks()[kept.landmark];
      if (landmark) scrollBy(0, top(landmark) - kept.top);
    }
    const keep = () => {
      const landmark = landmarks().findIndex((node) => node.getBoundingClientRect().bottom > 0);
      sessionStorage.setItem("saclab", JSON.stringify({
        checked: Object.fromEntries(inputs().map(([name, input]) => [name, input.checked])),
        open: details().filter(([, node]) => node.open).map(([name]) => name),
        landmark,
        top: landmark < 0 ? 0 : top(landmarks()[landmark]),
      }));
    };
    setInterval(async () => {
      try {
        if (await (await fetch("version")).text() === version) return;
      } catch { return; }
      keep();
      location.reload();
    }, 2000);
  }
})();
