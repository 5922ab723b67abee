"""A comparison as one HTML file with its pictures inside."""

import base64

from .tables import Report

TEMPLATE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>{{ report.title }}</title>
<style>
body { font: 15px/1.45 system-ui, sans-serif; max-width: 1200px; margin: 2em auto; padding: 0 1em }
table { border-collapse: collapse; margin: 1em 0; font-size: 13px }
td, th { padding: .25em .6em; border-bottom: 1px solid #ddd; text-align: right }
td:first-child, th:first-child { text-align: left }
.verdict { background: #f3f1ea; padding: .7em 1em }
img { width: 100% }
</style>
<h1>{{ report.title }}</h1>
{% for verdict in report.verdicts %}
<p class="verdict"><b>{{ verdict.given }}:</b> {{ verdict.text }}</p>
{% endfor %}
<img src="data:image/png;base64,{{ figure }}" alt="pictures and errors">
{% for note in report.notes %}
<p>{{ note }}</p>
{% endfor %}
{% for table in report.tables %}
{% if table.title %}
<h2>{{ table.title }}</h2>
{% endif %}
{% if table.note %}
<p>{{ table.note }}</p>
{% endif %}
<table>
<tr>{% for name in table.head %}<th>{{ name }}</th>{% endfor %}</tr>
{% for row in table.rows %}
<tr>{% for entry in row %}<td>{% if entry.best %}<b>{{ entry.text }}</b>{% else %}{{ entry.text }}{% endif %}</td>{% endfor %}</tr>
{% endfor %}
</table>
{% endfor %}
<p>{{ report.footer }}</p>
</html>
"""  # noqa: E501


def page(report: Report, figure: bytes) -> str:
    """The report as HTML, around a PNG figure."""
    from jinja2 import Environment

    template = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(TEMPLATE)
    return template.render(report=report, figure=base64.b64encode(figure).decode())
