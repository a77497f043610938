"""The look of a report; print gives the same."""

STYLE = """
:root{color-scheme:light}
*{box-sizing:border-box}
body{margin:0;background:#f3f5f8;color:#20242b;font:15px/1.5 system-ui,"Segoe UI","DejaVu Sans",sans-serif}
main{max-width:1080px;margin:0 auto;padding:28px 32px;background:#fff;min-height:100vh}
header{display:flex;align-items:baseline;justify-content:space-between;gap:16px;flex-wrap:wrap}
h1,h2,code{overflow-wrap:anywhere}
h1{font-size:21px;margin:0}
h2{font-size:16px;margin:28px 0 8px;border-bottom:1px solid #e3e7ed;padding-bottom:4px}
.when{margin:0;color:#667}
.verdict{font-size:17px;padding:12px 16px;border-left:5px solid;border-radius:4px;margin:16px 0}
.good{border-color:#009e73;background:#eaf7f2}
.look{border-color:#e69f00;background:#fdf5e3}
.bad{border-color:#d55e00;background:#fdece3}
ul.odd{margin:8px 0;padding-left:22px}
figure{margin:14px 0}
svg{width:100%;height:auto;display:block}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-size:13.5px;font-variant-numeric:tabular-nums}
th{text-align:left;color:#667;font-weight:600;border-bottom:1px solid #d5dae2;padding:4px 10px 4px 0}
td{border-bottom:1px solid #eef0f4;padding:4px 10px 4px 0;vertical-align:top}
td:first-child{white-space:nowrap}
code{font-size:12px;background:#f3f5f8;padding:1px 5px;border-radius:3px}
dl{display:grid;grid-template-columns:max-content 1fr;gap:4px 18px;margin:10px 0;font-size:14px}
dt{color:#667}
dd{margin:0}
footer{margin-top:30px;color:#889;font-size:12px}
@media print{body{background:#fff}main{padding:0}section,figure{break-inside:avoid}}
"""
