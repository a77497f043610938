// Fetches the options of some charts, by name, and shows them; `ids` are those of their elements.
window.membraneDrawCharts = async (ids, url) => {
  const answer = await fetch(window.path_prefix + url);
  if (!answer.ok) return;
  const options = await answer.json();
  const decade = (value) => (value >= 0.01 && value < 1e4 ? `${value}` : `1e${Math.round(Math.log10(value))}`);
  for (const [name, id] of Object.entries(ids)) {
    for (const axis of options[name].yAxis) if (axis.type === 'log') axis.axisLabel.formatter = decade;
    getElement(id)?.chart?.setOption(options[name], { notMerge: true });
  }
};
