"use strict";
const at = (id) => document.getElementById(id);
const drawn = (name, values) => {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(values)) element.setAttribute(key, value);
  return element;
};
const text = (name, content) => {
  const element = document.createElement(name);
  element.textContent = content;
  return element;
};
let shown = 0;

function show(state) {
  at("title").textContent = state.title;
  document.title = state.title;
  if (at("words").textContent !== state.words) at("words").textContent = state.words;
  at("words").className = state.taken ? "taken" : "";
  if (!state.number || state.number === shown) return;
  shown = state.number;
  at("picture").src = "/frame.jpg?" + shown;
  const { width, height, covered } = state;
  at("marks").setAttribute("viewBox", `-0.5 -0.5 ${width} ${height}`);
  const cells = covered.flatMap((row, r) => row.map((seen, c) => [r, c, seen])).filter((cell) => cell[2]);
  const [across, down] = [width / covered[0].length, height / covered.length];
  at("marks").replaceChildren(
    ...cells.map(([r, c]) => drawn("rect", { x: c * across - 0.5, y: r * down - 0.5, width: across, height: down })),
    ...state.points.map(([x, y]) => drawn("circle", { cx: x, cy: y, r: width / 150, "stroke-width": width / 500 })),
  );
  at("histogram").replaceChildren(
    ...state.histogram.map((high, k) => drawn("rect", { x: k, y: 20 * (1 - high), width: 1, height: 20 * high })),
  );
  const percent = 100 * state.saturated;
  at("saturated").textContent = (percent && percent < 0.1 ? "less than 0.1" : percent.toFixed(1)) + " %";
  const pixels = (value) => (value === null ? "none" : value.toFixed(2) + " px");
  at("edge").textContent = pixels(state.edge_px);
  at("sharpest").textContent = pixels(state.sharpest_px);
  at("share").textContent = Math.round((100 * cells.length) / (covered.length * covered[0].length)) + " %";
  at("frames").textContent = state.frames;
  at("wanted").textContent = state.wanted;
  at("progress").value = state.frames / Math.max(1, state.wanted);
  if (state.verdict.length) at("verdict").replaceChildren(...state.verdict.map((line) => text("p", line)));
  at("sigmas").replaceChildren(
    ...Object.entries(state.sigmas).map(([name, value]) => {
      const pair = document.createElement("div");
      pair.append(text("dt", name.replace("sigma_", "σ of ")), text("dd", value));
      return pair;
    }),
  );
}

async function update() {
  try {
    show(await (await fetch("/state.json")).json());
    setTimeout(update, 250);
  } catch {
    at("words").textContent = "ended, or no connection";
    setTimeout(update, 2000);
  }
}
update();
