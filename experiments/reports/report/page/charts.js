// Plotly charts. Each is a function that gives traces and layout from the data and the theme; it is
// drawn when it comes into view, and again when the theme or the methods shown change.

const CONFIG = {
  displaylogo: false,
  // Plotly's default is a button that sends a chart's data to its maker's server.
  showSendToCloud: false,
  plotlyServerURL: "",
  responsive: true,
  modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
};
const charts = [];
let group = 0;
let stage = "estimated";
let marked = null; // the iteration the map shows

function baseLayout() {
  const grid = { gridcolor: colour("line"), zerolinecolor: colour("line"), linecolor: colour("line") };
  const font = { family: getComputedStyle(document.body).fontFamily, size: 12.5, color: colour("muted") };
  return {
    grid,
    layout: {
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      font,
      showlegend: false,
      margin: { l: 62, r: 12, t: 34, b: 44 }, // the buttons stand above the plot
      hoverlabel: { bgcolor: colour("sheet"), bordercolor: colour("line"), font: { ...font, color: colour("ink") } },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: colour("muted"), activecolor: colour("ink") },
    },
  };
}

function line(name) {
  const style = styleOf.get(name);
  return { color: colour(style.colour), dash: style.dash, width: style.colour === "ink" ? 1.6 : 2 };
}

/** Plotly takes a few tags and entities in texts for markup: names must not be able to use them. */
function plain(text) {
  return text.replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");
}

/** A band and its median, both with gaps where there was no estimate. */
function bandTraces(x, curve, name, yaxis) {
  const style = styleOf.get(name);
  const shared = { x, xaxis: "x", yaxis, name: plain(name), legendgroup: plain(name), visible: !hidden.has(name) };
  const edge = { ...shared, mode: "lines", line: { width: 0 }, hoverinfo: "skip" };
  const text = curve.median.map((m, i) => `${short(m)} <span style="font-size:0.85em">(${short(curve.low[i])}–${short(curve.high[i])})</span>`);
  return [
    ...stretches(curve).map(([from, to]) => ({
      ...edge,
      x: [...x.slice(from, to), ...x.slice(from, to).reverse()],
      y: [...curve.low.slice(from, to), ...curve.high.slice(from, to).reverse()],
      fill: "toself",
      fillcolor: faint(style.colour, 0.14),
    })),
    { ...shared, y: curve.median, mode: "lines+markers", line: line(name), marker: { size: 5, symbol: style.marker }, text, hovertemplate: "%{text}" },
  ];
}

function stretches(curve) {
  const found = [];
  let from = null;
  curve.median.forEach((value, i) => {
    if (value !== null && from === null) from = i;
    if (value === null && from !== null) { found.push([from, i]); from = null; }
  });
  if (from !== null) found.push([from, curve.median.length]);
  return found.filter(([a, b]) => b - a > 1);
}

function errorChart() {
  const { grid, layout } = baseLayout();
  const curves = DATA.groups[group].curves;
  const x = curves.iteration;
  const traces = [];
  for (const { name } of DATA.aligners) {
    traces.push(...bandTraces(x, curves.aligners[name][`translation_${stage}`], name, "y"));
    traces.push(...bandTraces(x, curves.aligners[name][`rotation_${stage}`], name, "y2"));
  }
  const offered = { x, xaxis: "x", yaxis: "y3", mode: "lines", line: { width: 1.5 }, hovertemplate: "%{y}" };
  traces.push({ ...offered, y: curves.n_correspondences, name: "offered", line: { width: 1.2, color: colour("muted"), dash: "dot" } });
  traces.push({ ...offered, y: curves.n_true, name: "true", fill: "tozeroy", fillcolor: faint("ink", 0.12), line: { width: 1.5, color: colour("ink") } });
  const log = { ...grid, type: "log", tickformat: "~g", dtick: 1, minor: { showgrid: false }, exponentformat: "none" };
  const title = (text) => ({ text, standoff: 6, font: { size: 12.5 } });
  return {
    traces,
    layout: {
      ...layout,
      hovermode: "x unified",
      hoverdistance: -1, // wherever the pointer is, the nearest iteration
      xaxis: { ...grid, anchor: "y3", title: title("FastSLAM iteration k"), range: padded(x), hoverformat: "d" },
      yaxis: { ...log, domain: [0.58, 1], title: title("translation error (m)") },
      yaxis2: { ...log, domain: [0.2, 0.56], title: title("rotation error (rad)") },
      yaxis3: { ...grid, domain: [0, 0.15], title: title("pairs"), rangemode: "tozero", nticks: 3 },
      shapes: [...curves.scarce.map(shade), ...mark()],
    },
  };
}

function padded(x) {
  const margin = 0.015 * (x[x.length - 1] - x[0] || 1);
  return [x[0] - margin, x[x.length - 1] + margin];
}

function shade([from, to]) {
  return { type: "rect", xref: "x", yref: "paper", x0: from, x1: to, y0: 0, y1: 1, fillcolor: faint("muted", 0.16), line: { width: 0 }, layer: "below" };
}

function mark() {
  if (marked === null) return [];
  return [{ type: "line", xref: "x", yref: "paper", x0: marked, x1: marked, y0: 0, y1: 1, line: { color: colour("warm"), width: 1.5 } }];
}

const DODGE = 0.055; // of a bin: intervals of several methods stand side by side

function successChart(curves) {
  const { grid, layout } = baseLayout();
  const shown = DATA.aligners.filter(({ name }) => !hidden.has(name));
  const traces = shown.map(({ name }, place) => {
    const own = curves.aligners[name];
    const shift = DODGE * (place - (shown.length - 1) / 2);
    const gap = (from, to) => own.rate.map((rate, i) => (rate === null ? null : 100 * (to(i) - from(i))));
    return {
      x: own.rate.map((_, i) => i + shift),
      y: own.rate.map(inPercent),
      name: plain(name),
      mode: "lines+markers",
      line: { ...line(name), width: 1.5 },
      marker: { size: 6, symbol: styleOf.get(name).marker },
      error_y: {
        type: "data", symmetric: false, thickness: 1.5, width: 0, color: faint(styleOf.get(name).colour, 0.45),
        array: gap((i) => own.rate[i], (i) => own.high[i]),
        arrayminus: gap((i) => own.low[i], (i) => own.rate[i]),
      },
      text: own.rate.map((rate, i) => `${plain(name)}: ${percent(rate)} (${percent(own.low[i])} to ${percent(own.high[i])}), ${own.n[i]} maps`),
      hovertemplate: "%{text}<extra></extra>",
    };
  });
  return {
    traces,
    layout: {
      ...layout,
      hovermode: "closest",
      xaxis: { ...grid, showgrid: false, tickvals: curves.bins.map((_, i) => i), ticktext: curves.bins, title: { text: curves.label, standoff: 8 }, range: [-0.5, curves.bins.length - 0.5], automargin: true },
      yaxis: { ...grid, title: { text: "correct", standoff: 6 }, range: [-3, 103], ticksuffix: " %" },
    },
  };
}

const inPercent = (share) => (share === null ? null : 100 * share);

function percent(share) {
  return share === null ? "–" : `${Math.round(100 * share)} %`;
}

function timeChart() {
  const { grid, layout } = baseLayout();
  const traces = Object.entries(DATA.times).map(([name, own]) => ({
    x: own.n, y: own.median, name: plain(name), visible: !hidden.has(name),
    mode: "markers",
    marker: { size: 8, color: colour(styleOf.get(name).colour), symbol: styleOf.get(name).marker },
    error_y: { type: "data", symmetric: false, thickness: 1.2, width: 0, array: own.high.map((v, i) => v - own.median[i]), arrayminus: own.low.map((v, i) => own.median[i] - v) },
    text: own.median.map((v, i) => `${plain(name)}: ${short(v)} ms (${short(own.low[i])}–${short(own.high[i])}) for ${own.n[i]} pairs`),
    hovertemplate: "%{text}<extra></extra>",
  }));
  const log = { ...grid, type: "log", tickformat: "~g", exponentformat: "none", dtick: "D2" };
  return {
    traces,
    layout: { ...layout, hovermode: "closest", xaxis: { ...log, title: { text: "correspondences", standoff: 8 } }, yaxis: { ...log, title: { text: "time (ms)", standoff: 6 } } },
  };
}

function addChart(node, make) {
  const chart = { node, make, drawn: false };
  charts.push(chart);
  new IntersectionObserver((entries, watcher) => {
    if (entries.some((entry) => entry.isIntersecting)) {
      watcher.disconnect();
      draw(chart);
    }
  }, { rootMargin: "300px" }).observe(node);
  return chart;
}

function draw(chart) {
  const { traces, layout } = chart.make();
  chart.drawn = true;
  return Plotly.react(chart.node, traces, layout, CONFIG);
}

function redraw() {
  for (const chart of charts) if (chart.drawn) draw(chart);
}

const errors = addChart(byId("error-chart"), errorChart);
for (const curves of DATA.success) {
  const node = element("div", { class: "chart" });
  byId("success-charts").append(node);
  addChart(node, () => successChart(curves));
}
if (byId("time-chart")) addChart(byId("time-chart"), timeChart);

fillSelect(byId("group"), DATA.groups.map((each) => each.label));
byId("group").addEventListener("change", (event) => {
  group = Number(event.target.value);
  draw(errors);
  tell("group", { group });
});
segments({ estimated: byId("stage-estimated"), refined: byId("stage-refined") }, (name) => {
  stage = name;
  draw(errors);
});

let clickable = false;
function listenToClicks() {
  if (clickable || !errors.node.on) return;
  clickable = true;
  errors.node.on("plotly_click", (event) => tell("iteration", { iteration: event.points[0].x, from: "chart" }));
}
const drawErrors = errors.make;
errors.make = () => { queueMicrotask(() => setTimeout(listenToClicks)); return drawErrors(); };

BUS.addEventListener("theme", redraw);
BUS.addEventListener("methods", redraw);
let marking = 0;
BUS.addEventListener("iteration", (event) => {
  marked = event.detail.iteration;
  cancelAnimationFrame(marking);
  marking = requestAnimationFrame(() => {
    if (errors.drawn) Plotly.relayout(errors.node, { shapes: [...DATA.groups[group].curves.scarce.map(shade), ...mark()] });
  });
});
addEventListener("beforeprint", () => charts.filter(({ node }) => !node.closest("[hidden]")).forEach(draw));
