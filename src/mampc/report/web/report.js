"use strict";
// The page holds everything: `content` says what to show, Plotly draws it, and this changes what is shown.
const content = JSON.parse(document.getElementById("content").textContent);
const byId = (id) => document.getElementById(id);
const tradeoff = byId("tradeoff"), signals = byId("signals"), slider = byId("slider");
const touch = window.matchMedia("(pointer: coarse)").matches; // where dragging scrolls the page
const buttonsShown = [["zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d", "toImage"]];
const config = { responsive: true, displaylogo: false, modeBarButtons: buttonsShown };
const font = { family: "system-ui, sans-serif", size: 12, color: "#222" };
const HUES = ["#d55e00", "#009e73", "#cc79a7", "#8c6d1f", "#56b4e9", "#7a5195"]; // of groups, on the front
const [GREY, BLUE, BLACK, PALE] = ["#5c5c5c", "#0072b2", "#000000", "#b9cbd6"];
let scenario = 0, choice = 0;

// Plotly reads tags in its texts, and a name may hold what looks like one.
function plain(text, width) {
  const lines = [];
  for (const word of text.split(" ")) {
    const last = lines.length - 1;
    if (last >= 0 && (lines[last] + " " + word).length <= width) lines[last] += " " + word;
    else lines.push(word);
  }
  const safe = (line) => line.replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
  return lines.map(safe).join("<br>");
}

function short(text) { // of a point; the sentence above says the whole name
  return plain(text.length > 26 ? text.slice(0, 25).trim() + "…" : text, 26).replace(/<br>/g, " ");
}

function element(name, text, parent) {
  const made = document.createElement(name);
  made.textContent = text;
  parent.append(made);
  return made;
}

function decades(low, high) { // 1, 2, 5, 10, ... from below low to above high
  const ticks = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power += 1) {
    ticks.push(...[1, 2, 5].map((digit) => digit * 10 ** power));
  }
  return ticks;
}

function drawTradeoff() {
  const { choices, base } = content.scenarios[scenario];
  const best = choices.filter((one) => one.best);
  const top = Math.max(...choices.map((one) => one.x)) || 1, least = Math.min(...choices.map((one) => one.x));
  const place = (x) => (content.log ? Math.log(x / least) / (Math.log(top / least) || 1) : x / top);
  const groups = [...new Set(choices.map((one) => one.group).filter((group) => group))];
  const hue = (group) => HUES[groups.indexOf(group) % HUES.length];
  const colour = (i) => (i === choice ? BLUE : i === base ? GREY : choices[i].group ? hue(choices[i].group) : PALE);
  const points = {
    x: choices.map((one) => one.x), y: choices.map((one) => one.y), mode: "markers+text", cliponaxis: false,
    text: choices.map((one, i) => (i === choice || i === base ? short(one.name) : "")),
    textposition: choices.map((one, i) => {
      const side = place(one.x) < 0.2 ? "right" : place(one.x) > 0.8 ? "left" : "center";
      const above = choices.some((other) => other.y > one.y && Math.abs(place(other.x) - place(one.x)) < 0.15);
      return (above || i !== choice ? "bottom " : "top ") + side;
    }),
    marker: { size: choices.map((_, i) => (i === choice ? 15 : 11)), color: choices.map((_, i) => colour(i)), opacity: 1 },
    hovertext: choices.map((one) => plain(one.name, 40) + "<br>" + plain(one.short, 40)), hoverinfo: "text",
    showlegend: false,
  };
  const line = {
    x: best.map((one) => one.x), y: best.map((one) => one.y), mode: "lines", hoverinfo: "skip",
    line: { color: "#cccccc", width: 1.5, dash: "dot" }, showlegend: false,
  };
  const fronts = groups.map((group) => {
    const own = choices.filter((one) => one.group === group);
    return {
      x: own.map((one) => one.x), y: own.map((one) => one.y), mode: "lines", name: plain(group, 40), hoverinfo: "skip",
      line: { color: hue(group), width: 1.5 },
    };
  });
  const axis = { rangemode: "tozero", gridcolor: "#ebebeb", zerolinecolor: "#999", automargin: true };
  // On a telephone each front has a line of the legend, for which the figure grows.
  tradeoff.style.height = groups.length && tradeoff.clientWidth < 600 ? `${19 + 1.3 * groups.length}rem` : "";
  // The points come second, whatever is drawn beside them.
  Plotly.react(tradeoff, [line, points, ...fronts], {
    font, showlegend: groups.length > 0, legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom" }, dragmode: touch ? false : "zoom", hovermode: "closest", uirevision: scenario,
    margin: { l: 50, r: 20, t: 10, b: 45 },
    // Moves of fronts differ by factors.
    xaxis: content.log ? { ...axis, rangemode: "normal", type: "log", title: { text: content.x }, tickvals: decades(least, top) }
      : { ...axis, title: { text: content.x }, range: [0, 1.12 * top] },
    yaxis: { ...axis, title: { text: content.y } },
  }, { ...config, displayModeBar: false });
}

function drawSignals() {
  const { time, panels, choices, base } = content.scenarios[scenario];
  const own = choices[choice], other = choices[base];
  const narrow = signals.clientWidth < 600;
  const height = narrow ? 150 : 170, total = 100 + height * panels.length;
  const layout = {
    font, height: total, hovermode: "x unified", dragmode: touch ? false : "zoom", uirevision: scenario,
    margin: { l: 50, r: 12, t: 60, b: 40 }, shapes: [], annotations: [],
    legend: { orientation: "h", x: 0, y: 1 + 4 / (total - 100), yanchor: "bottom" },
    xaxis: { title: { text: `time (${content.unit})` }, anchor: panels.length > 1 ? `y${panels.length}` : "y", gridcolor: "#ebebeb" },
  };
  const traces = [];
  const seen = new Set();
  const draw = (values, name, colour, staircase, dash, axis, width) => {
    if (!values) return;
    traces.push({
      x: time, y: values, name: plain(name, 30), legendgroup: name, showlegend: !seen.has(name), yaxis: axis, mode: "lines",
      line: { color: colour, width, dash, shape: staircase ? "hv" : "linear" },
    });
    seen.add(name);
  };
  panels.forEach((panel, i) => {
    const axis = i ? `y${i + 1}` : "y", space = 34 / (total - 100);
    const upper = 1 - i / panels.length, lower = 1 - (i + 1) / panels.length;
    layout[i ? `yaxis${i + 1}` : "yaxis"] = {
      domain: [lower, Math.max(lower + 0.01, upper - space)], range: panel.range, gridcolor: "#ebebeb", zeroline: false, automargin: true,
    };
    layout.annotations.push({
      text: plain(panel.title, narrow ? 44 : 100), x: 0, y: upper - space, xref: "paper", yref: "paper", xanchor: "left",
      yanchor: "bottom", align: "left", showarrow: false, font: { size: 13 },
    });
    for (const limit of panel.limits) {
      layout.shapes.push({
        type: "line", xref: "paper", x0: 0, x1: 1, yref: axis, y0: limit, y1: limit, line: { color: BLACK, width: 1, dash: "dot" },
      });
    }
    if (panel.zone) {
      const [low, high] = panel.zone;
      for (const [values, fill] of [[low, "none"], [high, "tonexty"]]) {
        traces.push({
          x: time, y: values, name: "zone", legendgroup: "zone", showlegend: fill !== "none" && !seen.has("zone"), yaxis: axis,
          mode: "lines", line: { color: "rgba(92,92,92,0.5)", width: 0.8, shape: "hv" }, fill, fillcolor: "rgba(92,92,92,0.18)",
          hoverinfo: "skip",
        });
      }
      seen.add("zone");
    }
    draw(panel.reference, "reference", BLACK, true, "dash", axis, 1);
    draw(other.signals[i], other.name, GREY, panel.staircase, "solid", axis, 1.5);
    if (choice !== base) draw(own.signals[i], own.name, BLUE, panel.staircase, "solid", axis, 2);
  });
  Plotly.react(signals, traces, layout, config);
}

function fillWear() {
  const { choices, base } = content.scenarios[scenario];
  const body = byId("wear").tBodies[0];
  body.replaceChildren();
  choices[choice].wear.forEach((row, i) => {
    const line = document.createElement("tr");
    const compared = choices[base].wear[i];
    row.forEach((cell, j) => element("td", j && choice !== base ? `${compared[j]} → ${cell}` : cell, line));
    body.append(line);
  });
}

function show() {
  const { choices } = content.scenarios[scenario];
  byId("sentence").textContent = choices[choice].sentence;
  slider.value = choice;
  slider.setAttribute("aria-valuetext", choices[choice].name);
  for (const table of document.querySelectorAll("table[data-scenario]")) {
    table.parentElement.hidden = Number(table.dataset.scenario) !== scenario;
    [...table.tBodies[0].rows].forEach((row, i) => row.classList.toggle("chosen", i === choice));
  }
  drawTradeoff();
  drawSignals();
  fillWear();
}

function enter(number) {
  scenario = number;
  choice = content.scenarios[scenario].first;
  slider.max = content.scenarios[scenario].choices.length - 1;
  slider.disabled = slider.max === "0";
  show();
}

const buttons = byId("scenarios");
content.scenarios.forEach((one, i) => {
  const label = element("label", "", buttons), button = document.createElement("input");
  Object.assign(button, { type: "radio", name: "scenario", checked: i === 0 });
  button.addEventListener("change", () => enter(i));
  label.append(button, " " + one.name);
});
buttons.hidden = content.scenarios.length === 1;
slider.addEventListener("input", () => { choice = Number(slider.value); show(); });
enter(0);
tradeoff.on("plotly_click", (event) => {
  const point = event.points.find((one) => one.curveNumber === 1);
  if (point) { choice = point.pointNumber; show(); }
});
// A printed page is narrower than the window.
window.addEventListener("beforeprint", () => { for (const plot of [tradeoff, signals]) Plotly.relayout(plot, { width: 680 }); });
window.addEventListener("afterprint", () => {
  for (const plot of [tradeoff, signals]) Plotly.relayout(plot, { width: null, autosize: true });
});
