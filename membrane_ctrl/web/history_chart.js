// The history chart: what its options cannot carry as data.

// A table of each signal's minimum, mean and maximum at the cursor.
window.membraneTooltip = (points) => {
  const shown = points.filter((point) => point.value.length === 4);
  if (!shown.length) return '';
  const series = window.membraneSeries || {};
  const row = (point) => {
    const { unit = '', decimals = 2 } = series[point.seriesId] || {};
    const text = (value) => (value === null || value === undefined ? '–' : value.toFixed(decimals));
    const [, mean, low, high] = point.value;
    const cells = [low, mean, high].map((v) => `<td style="text-align:right;padding-left:1em">${text(v)}</td>`);
    return `<tr><td>${point.marker}${point.seriesName}</td>${cells.join('')}<td>&nbsp;${unit}</td></tr>`;
  };
  const titles = ['minimum', 'mean', 'maximum'].map((t) => `<td style="text-align:right;padding-left:1em">${t}</td>`);
  const head = `<tr><td></td>${titles.join('')}<td></td></tr>`;
  const time = new Date(shown[0].value[0]).toISOString().slice(0, 19).replace('T', ' ');
  return `${time}<table>${head}${shown.map(row).join('')}</table>`;
};

// Fetches the options, shows them, and tells the page where a viewer clicks.
window.membraneDrawHistory = async (id, url) => {
  const answer = await fetch(window.path_prefix + url);
  if (!answer.ok) return;
  const options = await answer.json();
  window.membraneSeries = Object.fromEntries(options.series.filter((s) => s.id).map((s) => [s.id, s]));
  options.tooltip.formatter = window.membraneTooltip;
  const element = getElement(id);
  const chart = element.chart;
  const panels = options.grid.length;
  // another number of panels needs a new chart; otherwise the viewer's zoom stays
  const isNew = (chart.getOption()?.grid || []).length !== panels;
  chart.setOption(options, { notMerge: isNew, replaceMerge: ['series'] });
  if (chart.membraneClicks) return;
  chart.membraneClicks = true;
  chart.getZr().on('click', (event) => {
    const point = [event.offsetX, event.offsetY];
    if (!chart.containPixel('grid', point)) return;
    emitEvent('membrane_chart_clicked', chart.convertFromPixel({ xAxisIndex: 0 }, point[0]));
  });
};
