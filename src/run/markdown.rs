//! The little Markdown that ops write into their reports, as HTML: headings, paragraphs, lists, tables, code, emphasis.

use std::fmt::Write as _;

/// Turns Markdown into HTML. Everything else is shown as it is written; nothing is ever passed through as HTML.
pub fn html(markdown: &str) -> String {
    let lines: Vec<&str> = markdown.lines().collect();
    let mut out = String::new();
    let mut at = 0;
    while at < lines.len() {
        let line = lines[at].trim_end();
        if line.is_empty() {
            at += 1;
        } else if line.starts_with("```") {
            let end = (at + 1..lines.len())
                .find(|&i| lines[i].starts_with("```"))
                .unwrap_or(lines.len());
            let _ = writeln!(out, "<pre>{}</pre>", escape(&lines[at + 1..end].join("\n")));
            at = end + 1;
        } else if let Some((level, text)) = heading(line) {
            // The page has headings of its own above.
            let level = (level + 2).min(6);
            let _ = writeln!(out, "<h{level}>{}</h{level}>", inline(text));
            at += 1;
        } else if line.starts_with('|') {
            let end = (at..lines.len())
                .find(|&i| !lines[i].starts_with('|'))
                .unwrap_or(lines.len());
            out += &table(&lines[at..end]);
            at = end;
        } else if is_item(line) {
            let end = (at..lines.len())
                .find(|&i| !is_item(lines[i]))
                .unwrap_or(lines.len());
            let items = lines[at..end]
                .iter()
                .map(|item| format!("<li>{}</li>", inline(&item[2..])));
            let _ = writeln!(out, "<ul>{}</ul>", items.collect::<String>());
            at = end;
        } else {
            let stop = |line: &str| {
                line.trim().is_empty() || line.starts_with(['|', '#', '`']) || is_item(line)
            };
            let end = (at + 1..lines.len())
                .find(|&i| stop(lines[i]))
                .unwrap_or(lines.len());
            let _ = writeln!(out, "<p>{}</p>", inline(&lines[at..end].join(" ")));
            at = end;
        }
    }
    out
}

/// Text that stands for itself in HTML.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

fn heading(line: &str) -> Option<(usize, &str)> {
    let level = line.chars().take_while(|&c| c == '#').count();
    let text = line[level..].strip_prefix(' ')?;
    (1..=6).contains(&level).then_some((level, text))
}

fn is_item(line: &str) -> bool {
    line.starts_with("- ") || line.starts_with("* ")
}

fn cells(row: &str) -> Vec<&str> {
    row.trim()
        .trim_matches('|')
        .split('|')
        .map(str::trim)
        .collect()
}

fn table(rows: &[&str]) -> String {
    let rule = |row: &str| row.chars().all(|c| "|-: ".contains(c)) && row.contains('-');
    let right: Vec<bool> = rows
        .get(1)
        .filter(|row| rule(row))
        .map(|row| cells(row).iter().map(|cell| cell.ends_with(':')).collect())
        .unwrap_or_default();
    let mut out = String::from("<table>\n");
    for (index, row) in rows.iter().enumerate() {
        if index == 1 && rule(row) {
            continue;
        }
        let tag = if index == 0 && !right.is_empty() {
            "th"
        } else {
            "td"
        };
        out += "<tr>";
        for (column, cell) in cells(row).iter().enumerate() {
            let class = if right.get(column) == Some(&true) {
                " class=\"n\""
            } else {
                ""
            };
            let _ = write!(out, "<{tag}{class}>{}</{tag}>", inline(cell));
        }
        out += "</tr>\n";
    }
    out + "</table>\n"
}

/// `code` and **strong**.
fn inline(text: &str) -> String {
    let mut out = String::new();
    for (index, part) in text.split('`').enumerate() {
        if index % 2 == 1 {
            let _ = write!(out, "<code>{}</code>", escape(part));
            continue;
        }
        for (index, part) in part.split("**").enumerate() {
            let part = escape(part);
            if index % 2 == 1 {
                let _ = write!(out, "<strong>{part}</strong>");
            } else {
                out.push_str(&part);
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_with_alignment_becomes_a_table() {
        let made = html(
            "# Body\n\n| joint | mean, m |\n|---|---:|\n| `wrist` | **0.1** |\n\n- one\n- two\n",
        );
        assert_eq!(
            made,
            "<h3>Body</h3>\n<table>\n<tr><th>joint</th><th class=\"n\">mean, m</th></tr>\n\
             <tr><td><code>wrist</code></td><td class=\"n\"><strong>0.1</strong></td></tr>\n</table>\n\
             <ul><li>one</li><li>two</li></ul>\n"
        );
    }

    #[test]
    fn nothing_is_passed_through_as_html() {
        for text in [
            "<script>",
            "`<script>`",
            "| <script> |",
            "# <script>",
            "```\n<script>\n```",
            "- <script>",
            "**<script>**",
        ] {
            assert!(!html(text).contains("<script>"), "{text}");
        }
    }

    #[test]
    fn odd_input_ends() {
        for text in [
            "",
            "|",
            "```",
            "#",
            "####### seven",
            "|-|\n|-|",
            "*",
            "`",
            "**",
        ] {
            html(text);
        }
    }
}
