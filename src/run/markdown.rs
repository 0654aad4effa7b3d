//! The Markdown that ops write into their reports, as HTML.

use pulldown_cmark::{Alignment, CowStr, Event, HeadingLevel, Options, Parser, Tag, TagEnd};

/// Letters of a row that fit beside each other on the page.
const WIDTH: usize = 110;

/// Turns Markdown with tables into HTML. Nothing in it acts: HTML is shown as it is written, links and pictures are their
/// text. A table that is wider than the page becomes several, one below the other, each with the first column.
pub fn html(markdown: &str) -> String {
    let events =
        Parser::new_ext(markdown, Options::ENABLE_TABLES).filter_map(|event| match event {
            Event::Html(text) | Event::InlineHtml(text) => Some(Event::Text(text)),
            Event::Start(Tag::HtmlBlock | Tag::Link { .. } | Tag::Image { .. })
            | Event::End(TagEnd::HtmlBlock | TagEnd::Link | TagEnd::Image) => None,
            Event::Start(Tag::Heading { level, .. }) => Some(Event::Start(Tag::Heading {
                level: below(level),
                id: None,
                classes: Vec::new(),
                attrs: Vec::new(),
            })),
            Event::End(TagEnd::Heading(level)) => Some(Event::End(TagEnd::Heading(below(level)))),
            Event::SoftBreak => Some(Event::Text(CowStr::Borrowed(" "))),
            event => Some(event),
        });
    let mut out = String::new();
    pulldown_cmark::html::push_html(&mut out, folded(events).into_iter());
    out
}

/// A row of a table: its cells, each a list of events.
type Row<'a> = Vec<Vec<Event<'a>>>;

/// The events with wide tables folded.
fn folded<'a>(events: impl Iterator<Item = Event<'a>>) -> Vec<Event<'a>> {
    let mut out = Vec::new();
    let mut table: Option<(Vec<Alignment>, Vec<Row<'a>>)> = None;
    for event in events {
        let Some((_, rows)) = &mut table else {
            match event {
                Event::Start(Tag::Table(alignments)) => table = Some((alignments, Vec::new())),
                event => out.push(event),
            }
            continue;
        };
        match event {
            Event::Start(Tag::TableHead | Tag::TableRow) => rows.push(Vec::new()),
            Event::Start(Tag::TableCell) => rows
                .last_mut()
                .into_iter()
                .for_each(|row| row.push(Vec::new())),
            Event::End(TagEnd::TableHead | TagEnd::TableRow | TagEnd::TableCell) => {}
            Event::End(TagEnd::Table) => {
                if let Some((alignments, rows)) = table.take() {
                    bands(&alignments, &rows, &mut out);
                }
            }
            event => {
                if let Some(cell) = rows.last_mut().and_then(|row| row.last_mut()) {
                    cell.push(event);
                }
            }
        }
    }
    out
}

/// One table per band of columns that fit beside each other.
fn bands<'a>(alignments: &[Alignment], rows: &[Row<'a>], out: &mut Vec<Event<'a>>) {
    let letters = |cell: &Vec<Event<'_>>| -> usize {
        let text = cell.iter().map(|event| match event {
            Event::Text(text) | Event::Code(text) => text.chars().count(),
            _ => 0,
        });
        // The padding of a cell is as wide as two letters.
        2 + text.sum::<usize>()
    };
    let width = |column: usize| {
        let cells = rows.iter().filter_map(|row| row.get(column));
        cells.map(letters).max().unwrap_or(0)
    };
    let columns = alignments.len();
    let mut start = 1.min(columns);
    loop {
        let mut end = start;
        let mut used = width(0);
        while end < alignments.len() && (end == start || used + width(end) <= WIDTH) {
            used += width(end);
            end += 1;
        }
        let chosen: Vec<usize> = (0..start.min(1)).chain(start..end).collect();
        let aligned = chosen.iter().map(|column| alignments[*column]).collect();
        out.push(Event::Start(Tag::Table(aligned)));
        for (number, row) in rows.iter().enumerate() {
            let (open, close) = match number {
                0 => (Tag::TableHead, TagEnd::TableHead),
                _ => (Tag::TableRow, TagEnd::TableRow),
            };
            out.push(Event::Start(open));
            for cell in chosen.iter().filter_map(|column| row.get(*column)) {
                out.push(Event::Start(Tag::TableCell));
                out.extend(cell.iter().cloned());
                out.push(Event::End(TagEnd::TableCell));
            }
            out.push(Event::End(close));
        }
        out.push(Event::End(TagEnd::Table));
        if end >= columns {
            return;
        }
        start = end;
    }
}

/// Two levels down: the page has headings of its own above.
fn below(level: HeadingLevel) -> HeadingLevel {
    HeadingLevel::try_from(level as usize + 2).unwrap_or(HeadingLevel::H6)
}

/// Text that stands for itself in HTML.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_with_alignment_becomes_a_table() {
        let made = html(
            "# Body\n\n| joint | mean, m |\n|---|---:|\n| `wrist` | **0.1** *(mean pose)* |\n\n- one\n- two\n",
        );
        assert_eq!(
            made.replace('\n', ""),
            "<h3>Body</h3><table><thead><tr><th>joint</th><th style=\"text-align: right\">mean, m</th></tr></thead>\
             <tbody><tr><td><code>wrist</code></td><td style=\"text-align: right\"><strong>0.1</strong> \
             <em>(mean pose)</em></td></tr></tbody></table><ul><li>one</li><li>two</li></ul>"
        );
    }

    #[test]
    fn a_table_wider_than_the_page_is_folded_and_loses_nothing() {
        let columns: Vec<String> = (0..9).map(|k| format!("a metric number {k}")).collect();
        let line = |first: &str, cells: &[String]| format!("| {first} | {} |\n", cells.join(" | "));
        let values: Vec<String> = (0..9).map(|k| format!("value {k}")).collect();
        let text = line("row", &columns) + &"|---".repeat(10) + "|\n" + &line("`own`", &values);
        let made = html(&text);
        assert_eq!(made.matches("<table>").count(), 2);
        assert_eq!(made.matches("<code>own</code>").count(), 2);
        for word in columns.iter().chain(&values) {
            assert_eq!(
                made.matches(&format!(">{word}<")).count(),
                1,
                "{word}: {made}"
            );
        }
        assert_eq!(
            html("| a | b |\n|---|---|\n| 1 | 2 |\n")
                .matches("<table>")
                .count(),
            1
        );
        assert_eq!(html("| a |\n|---|\n| 1 |\n").matches("<td>").count(), 1);
    }

    #[test]
    fn nothing_is_passed_through_as_html() {
        for text in [
            "<script>",
            "`<script>`",
            "| <script> |\n|---|\n| <script> |",
            "# <script>",
            "```\n<script>\n```",
            "- <script>",
            "**<script>**",
            "one\n\n<script>\nalert(1)\n</script>\n",
            "[here](javascript:alert(1))",
            "![here](https://example.org/<script>)",
            "<javascript:alert(1)>",
        ] {
            let made = html(text);
            assert!(
                !["<script", "href", "src"]
                    .iter()
                    .any(|bad| made.contains(bad)),
                "{text}: {made}"
            );
        }
    }
}
