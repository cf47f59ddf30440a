(async () => {
  const frames = [...document.querySelectorAll(".graph")];
  const fail = text => frames.forEach(f => { f.textContent = text; f.classList.add("broken"); });
  if (!("DecompressionStream" in window)) {
    return fail("This browser is too old to unpack the interactive figures; the PDF report shows the same ones.");
  }
  const packed = atob(document.getElementById("library").textContent.trim());
  const bytes = Uint8Array.from(packed, c => c.charCodeAt(0));
  const code = await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  (0, eval)(code);
  const graphs = JSON.parse(document.getElementById("graphs").textContent);
  const axis = { gridcolor: "#e3e3e6", linecolor: "#555", zeroline: false, ticks: "outside", ticklen: 4, showline: true };
  const draw = frame => {
    const { data, layout: wide, narrow } = graphs[frame.dataset.name];
    const phone = frame.clientWidth < 560;
    const layout = phone && narrow || wide;
    const axes = Object.fromEntries(Object.entries(layout).filter(([k]) => /^[xy]axis/.test(k))
      .map(([k, v]) => [k, { ...axis, ...v }]));
    const entries = data.filter(t => t.showlegend).length;
    // The legend is below the graph, with one entry per row on a phone and about three elsewhere.
    const rows = layout.showlegend ? (phone ? entries : Math.ceil(entries / 3)) : 0;
    // Names of many stages under the x axis are turned on a phone and need room above the legend.
    const named = Object.entries(axes).filter(([k, v]) => k[0] === "x" && v.ticktext);
    const letters = Math.max(0, ...named.flatMap(([, v]) => v.ticktext.length < 5 ? [] : v.ticktext)
      .flatMap(name => name.split("<br>").map(part => part.length)));
    const turned = phone && letters > 6 ? 6.5 * letters - 14 : 0;
    if (turned) named.forEach(([, v]) => { v.tickangle = -90; });
    const plot = layout.height - 110, foot = 58 + turned + 20 * rows;
    Plotly.newPlot(frame, data, {
      ...layout, ...axes, height: plot + 26 + foot, paper_bgcolor: "#fff", plot_bgcolor: "#fff",
      font: { family: "system-ui, 'DejaVu Sans', sans-serif", size: phone ? 11 : 12.5, color: "#1d1d1f" },
      margin: { l: phone ? 52 : 68, r: 12, t: 26, b: foot },
      legend: { orientation: "h", x: 0, xanchor: "left", y: -(48 + turned) / plot, yanchor: "top", itemsizing: "constant", itemwidth: 46 },
      hovermode: "closest", dragmode: phone ? false : "zoom",
    }, { responsive: true, displaylogo: false, displayModeBar: phone ? false : "hover",
      modeBarButtons: [["toImage", "zoom2d", "pan2d", "resetScale2d"]] });
  };
  const seen = new IntersectionObserver(entries => entries.filter(e => e.isIntersecting).forEach(e => {
    seen.unobserve(e.target);
    draw(e.target);
  }), { rootMargin: "1500px" });
  frames.forEach(f => seen.observe(f));
  window.addEventListener("beforeprint", () => frames.filter(f => !f.childElementCount && f.clientWidth).forEach(draw));
})().catch(error => { document.querySelectorAll(".graph").forEach(f => {
  if (!f.childElementCount) { f.textContent = "The figure could not be drawn: " + error; f.classList.add("broken"); }
}); });
