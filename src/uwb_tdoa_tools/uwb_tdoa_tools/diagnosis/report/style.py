"""How a page looks: on a laptop, on a phone and on paper."""

NARROW = "44rem"  # a screen that is not wider is a phone
STYLE = """
:root { color-scheme: light }
* { box-sizing: border-box }
body { font: 16px/1.5 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; max-width: 66rem; margin: 0 auto;
  padding: 1rem; color: #1b1b1b; background: #fff; overflow-wrap: anywhere }
h1 { font-size: 1.3rem; line-height: 1.3; margin: .4rem 0 }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .4rem }
h3 { font-size: 1rem; margin: 1.4rem 0 .3rem }
p { margin: .4rem 0 }
small, .note, figcaption { color: #555; font-size: .875rem }
details details { border: 0 }
.verdict { border-left: .5rem solid #767676; background: #f2f5f8; padding: .7rem 1rem; margin: 1rem 0 }
.verdict p:first-child { font-size: 1.15rem; font-weight: 600 }
.better { border-color: #0072b2 }
.unsure { border-color: #e69f00 }
ol, ul { padding-left: 1.6rem }
li { margin: .5rem 0 }
li p { margin: .15rem 0 }
dt b, summary { font-weight: 600 }
dd { margin: 0 0 .4rem 0 }
code { font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: .875rem }
table { border-collapse: collapse; font-size: .9rem; margin: .5rem 0 }
td, th { border-bottom: 1px solid #ccc; padding: .3rem .7rem .3rem 0; text-align: left; vertical-align: top;
  overflow-wrap: normal }
td.number, th.number { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums }
.wide { overflow-x: auto; max-width: 100% }
.bar { display: inline-block; height: .8em; min-width: 1px; margin-right: .4em; background: #0072b2;
  print-color-adjust: exact; -webkit-print-color-adjust: exact }
.grid { display: grid; gap: 0 1.5rem; grid-template-columns: repeat(auto-fit, minmax(min(100%, 27rem), 1fr)) }
figure { margin: .8rem 0; min-width: 0 }
img { display: block; max-width: 100%; height: auto }
.grid img { width: 100% }
.grid figure { max-width: 38rem }
details { border-top: 1px solid #ccc; padding: .4rem 0 }
summary { cursor: pointer }
@media (max-width: 44rem) {
  .stack thead { display: none }
  .stack tr { display: block; border-bottom: 2px solid #999; padding: .4rem 0 }
  .stack td { display: block; border: 0; padding: .1rem 0 }
  .stack td::before { content: attr(data-name) ": "; color: #555 }
}
@media print {
  body { max-width: none; font-size: 11pt }
  figure, li, tr { break-inside: avoid }
  h2, h3, summary { break-after: avoid }
  .wide { overflow: visible }
  .wide td, .wide th { font-size: 8pt; padding-right: .4rem }
  details::details-content { content-visibility: visible; height: auto }
}
"""
