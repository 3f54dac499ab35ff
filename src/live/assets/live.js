"use strict";
(() => {
  const root = document.documentElement;
  const by = (id) => document.getElementById(id);
  const css = (name) => getComputedStyle(root).getPropertyValue(name).trim();
  const FONT = '12px system-ui, "Noto Sans", Arial, sans-serif';
  // Longest time, s, and largest number of points that the figures show.
  const WINDOW_S = 10, MOST = 1200;
  const fixed = (value, digits, unit) => (value == null ? "–" : `${value.toFixed(digits)} ${unit}`);

  let server = null, status = null, rollout = null, end = null, lost = 0, latest = null, heard = 0, waiting = false;
  const columns = [[], [], [], []];

  // Facts, in words.
  const timeLeft = (seconds) => (seconds == null ? "–" : seconds < 120 ? `${Math.round(seconds)} s` : `${Math.round(seconds / 60)} min`);
  const showFacts = () => {
    const facts = [["connection", root.dataset.connected === "1" ? "live" : "lost"]];
    if (status) {
      facts.push(["command", status.command || "–"]);
      // Candidates count from 0 everywhere; the second number counts the candidates that have begun.
      const of = status.of == null ? "" : ` (${status.candidate + 1} of ${status.of})`;
      if (status.candidate != null) facts.push(["candidate", `${status.candidate}${of}`]);
      facts.push(["best so far", fixed(status.best_return, 1, "of 600")], ["time left", timeLeft(status.time_left_s)]);
    }
    if (rollout) {
      facts.push(["rollout", `${rollout.rollout}`], ["policy", rollout.policy]);
      const isOver = end && end.number === rollout.number;
      facts.push(["phase", isOver ? end.ending : latest ? rollout.phases[latest[4]] : "–"]);
    }
    if (lost) facts.push(["not shown", `${lost} ticks: this page is slow`]);
    const list = by("facts");
    list.textContent = "";
    for (const [name, value] of facts) {
      const pair = document.createElement("div");
      for (const [kind, text] of [["dt", name], ["dd", value]]) {
        const made = document.createElement(kind);
        made.textContent = text;
        pair.appendChild(made);
      }
      list.appendChild(pair);
    }
    by("doing").textContent = status ? (status.ended ? "the command has ended" : status.doing || "at work") : "connecting …";
    if (status && status.stop_requested) stopped("stop requested: the arm is braked and the state is kept", true);
  };

  // The pendulum, seen from above its front.
  const drawScene = () => {
    const canvas = by("scene"), scale = devicePixelRatio;
    const width = Math.max(240, canvas.clientWidth), height = Math.min(320, Math.round(width * 0.7));
    canvas.width = width * scale;
    canvas.height = height * scale;
    canvas.style.height = `${height}px`;
    const ctx = canvas.getContext("2d");
    ctx.scale(scale, scale);
    if (!rollout || !latest || latest[1] == null || latest[2] == null) return;
    const { arm_m: arm, pendulum_m: pendulum } = rollout;
    const [theta, alpha] = [latest[1], latest[2]];
    // The whole reach of arm and pendulum fits into the canvas.
    const size = Math.min((0.5 * width - 8) / (1.1 * Math.hypot(arm, pendulum)), (0.5 * height - 8) / (0.5 * arm + pendulum));
    const flat = ([x, y, z]) => [width / 2 + size * (y - 0.35 * x), height / 2 + size * (0.5 * x - z)];
    const line = (from, to, thick, paint) => {
      ctx.beginPath();
      ctx.moveTo(...flat(from));
      ctx.lineTo(...flat(to));
      ctx.lineWidth = thick;
      ctx.lineCap = "round";
      ctx.strokeStyle = paint;
      ctx.stroke();
    };
    // The circle of the arm's tip; the part that the limits allow is drawn darker.
    const arc = (from, to, paint, thick) => {
      ctx.beginPath();
      for (let step = 0; step <= 60; step++) {
        const angle = from + (to - from) * step / 60;
        ctx.lineTo(...flat([arm * Math.cos(angle), arm * Math.sin(angle), 0]));
      }
      ctx.lineWidth = thick;
      ctx.strokeStyle = paint;
      ctx.stroke();
    };
    const limit = Math.min(rollout.theta_limit_rad, Math.PI);
    arc(-Math.PI, Math.PI, css("--line"), 1);
    arc(-limit, limit, css("--ink2"), 2);
    const tip = [arm * Math.cos(theta), arm * Math.sin(theta), 0];
    const swing = pendulum * Math.sin(alpha);
    const free = [tip[0] - swing * Math.sin(theta), tip[1] + swing * Math.cos(theta), -pendulum * Math.cos(alpha)];
    line([0, 0, -0.9 * pendulum], [0, 0, 0], 10, css("--line"));
    line([0, 0, 0], tip, 6, css("--ink2"));
    line(tip, free, 5, css("--c0"));
    ctx.beginPath();
    ctx.arc(...flat(free), 6, 0, 7);
    ctx.fillStyle = css("--c0");
    ctx.fill();
    by("now").textContent = `${latest[0].toFixed(2)} s · ${rollout.phases[latest[4]]} · θ ${fixed(theta, 2, "rad")} · ` +
      `α ${fixed(alpha, 2, "rad")} · ${fixed(latest[3], 2, "V")}`;
  };

  // The figures.
  const limits = (u, most) => {
    if (!most) return;
    const { ctx, bbox } = u;
    ctx.save();
    ctx.strokeStyle = css("--limit");
    ctx.setLineDash([5 * devicePixelRatio, 4 * devicePixelRatio]);
    ctx.lineWidth = devicePixelRatio;
    for (const at of [most, -most]) {
      const y = u.valToPos(at, "y", true);
      if (y < bbox.top || y > bbox.top + bbox.height) continue;
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
    }
    ctx.restore();
  };
  const makePlot = (id, name, unit, colour, most) => {
    const div = by(id);
    const axis = (label, size) => ({
      label, labelFont: FONT, labelSize: 20, size, font: FONT, stroke: () => css("--ink2"),
      grid: { stroke: () => css("--line"), width: 1 }, ticks: { stroke: () => css("--line"), width: 1 },
    });
    const range = (u, low, high) => {
      const limit = most();
      const least = Math.min(low == null ? 0 : low, limit ? -1.08 * limit : -0.1);
      const largest = Math.max(high == null ? 0 : high, limit ? 1.08 * limit : 0.1);
      return [least, largest];
    };
    return new uPlot({
      width: Math.max(240, div.clientWidth), height: 170,
      scales: { x: { time: false }, y: { range } },
      axes: [axis("time since the rollout's start [s]", 34), axis(`${name} [${unit}]`, 54)],
      series: [{ label: "time [s]" }, { label: `${name} [${unit}]`, stroke: () => css(colour), width: 1.5, points: { show: false } }],
      hooks: { draw: [(u) => limits(u, most())] },
    }, [[], []], div);
  };
  const plots = [
    makePlot("theta", "θ", "rad", "--c0", () => rollout && rollout.theta_limit_rad),
    makePlot("alpha", "α", "rad", "--c1", () => Math.PI),
    makePlot("voltage", "voltage", "V", "--c2", () => rollout && rollout.voltage_limit_v),
  ];
  const draw = () => {
    waiting = false;
    drawScene();
    plots.forEach((plot, index) => plot.setData([columns[0], columns[index + 1]]));
    showFacts();
  };
  const soon = () => {
    if (!waiting) {
      waiting = true;
      requestAnimationFrame(draw);
    }
  };

  // The stream of events. If it breaks, the browser connects again by itself.
  const clear = () => columns.forEach((column) => { column.length = 0; });
  const source = new EventSource("events");
  const on = (name, take) => source.addEventListener(name, (event) => { take(JSON.parse(event.data)); soon(); });
  // Another view at this address, such as the view of a resumed session, shares nothing with the last.
  on("server", (it) => {
    if (server !== null && server !== it) {
      [status, rollout, end, latest, lost] = [null, null, null, null, 0];
      clear();
      by("now").textContent = "";
      stopped("", false);
    }
    server = it;
  });
  on("status", (it) => { status = it; });
  on("rollout", (it) => { rollout = it; latest = null; clear(); });
  on("end", (it) => { end = it; });
  on("lost", (it) => { lost += it; });
  on("ticks", (ticks) => {
    for (const tick of ticks) {
      if (!rollout || tick[5] !== rollout.number) continue;
      latest = tick;
      heard += 1;
      [0, 1, 2, 3].forEach((index) => columns[index].push(tick[index]));
    }
    if (latest) {
      let first = Math.max(0, columns[0].length - MOST);
      while (columns[0][first] < latest[0] - WINDOW_S) first += 1;
      if (first) columns.forEach((column) => column.splice(0, first));
    }
    root.dataset.heard = heard;
  });
  source.onopen = () => { root.dataset.connected = "1"; soon(); };
  source.onerror = () => { root.dataset.connected = "0"; soon(); };

  // The Stop button sends a request of its own, which waits for no figure.
  const button = by("stop");
  const stopped = (text, isDone) => {
    by("stopped").textContent = text;
    button.disabled = isDone;
  };
  button.addEventListener("click", async () => {
    const headers = { "X-Qube-Hil": "stop" };
    const token = location.hash.slice(1);
    if (token) headers.Authorization = `Bearer ${token}`;
    try {
      const answer = await fetch("stop", { method: "POST", headers });
      if (answer.ok) stopped("stop requested", true);
      else if (answer.status === 401) stopped("not stopped: open the address that the program printed, with its token", false);
      else stopped(`not stopped: ${answer.status} ${answer.statusText}`, false);
    } catch (error) {
      stopped("not stopped: the program does not answer. Press Ctrl-C there", false);
    }
  });

  by("address").textContent = `ws://${location.host}`;
  addEventListener("resize", () => {
    plots.forEach((plot, index) => plot.setSize({ width: Math.max(240, by(["theta", "alpha", "voltage"][index]).clientWidth), height: 170 }));
    soon();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { plots.forEach((plot) => plot.redraw()); soon(); });
  showFacts();
  drawScene();
  root.dataset.drawn = "1";
})();
