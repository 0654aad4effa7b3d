//! The Markdown that ops write into their reports, as HTML.

use pulldown_cmark::{CowStr, Event, HeadingLevel, Options, Parser, Tag, TagEnd};

/// Turns Markdown with tables into HTML. Nothing in it acts: HTML is shown as it is written, links and pictures are their
/// text.
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
    pulldown_cmark::html::push_html(&mut out, events);
    out
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
