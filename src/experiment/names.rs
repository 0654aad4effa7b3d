//! Did you mean: the nearest of some names.

/// The name nearest to `wrong`, if it is near enough to be meant.
pub fn nearest<'a>(wrong: &str, names: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let wrong: Vec<char> = wrong.chars().take(64).collect();
    let allowed = (wrong.len() / 3).max(1);
    names
        .map(|name| (distance(&wrong, name), name))
        .filter(|(distance, name)| {
            *distance <= allowed
                || (wrong.len() >= 3 && name.starts_with(&wrong.iter().collect::<String>()))
        })
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, name)| name)
}

/// Keys that had another name before version 0.2, as (old, new). Where a place knows the new one, an old one's error says it.
const RENAMED: &[(&str, &str)] = &[
    ("given", "inputs"),
    ("wanted", "targets"),
    ("more_tokens", "tokens"),
    ("recompute", "activation_checkpointing"),
    ("rate", "learning_rate"),
    ("velocity", "velocity_weight"),
    ("commitment", "commitment_weight"),
    ("floor", "reconstruction_bound"),
    ("hide", "uncond_drop"),
    ("draw", "sampling"),
    ("lens", "camera"),
];

/// What `old` is called since it was renamed, where that is one of the `known` keys.
pub fn renamed(old: &str, known: &[&str]) -> Option<&'static str> {
    RENAMED
        .iter()
        .find(|(name, new)| *name == old && known.contains(new))
        .map(|(_, new)| *new)
}

/// A sentence for a help line: the nearest name, or all of them where there are few.
pub fn suggest(wrong: &str, names: &[&str]) -> Option<String> {
    if let Some(near) = nearest(wrong, names.iter().copied()) {
        return Some(format!("did you mean `{near}`?"));
    }
    if names.is_empty() {
        return None;
    }
    let shown: Vec<String> = names
        .iter()
        .take(12)
        .map(|name| format!("`{name}`"))
        .collect();
    let more = names.len().saturating_sub(12);
    Some(if more == 0 {
        format!("one of {}", shown.join(", "))
    } else {
        format!("one of {} and {more} more", shown.join(", "))
    })
}

/// Edit distance with transpositions (optimal string alignment).
fn distance(a: &[char], b: &str) -> usize {
    let b: Vec<char> = b.chars().take(64).collect();
    let mut rows = vec![vec![0; b.len() + 1]; a.len() + 1];
    for (i, row) in rows.iter_mut().enumerate() {
        row[0] = i;
    }
    for (j, cell) in rows[0].iter_mut().enumerate() {
        *cell = j;
    }
    for i in 1..=a.len() {
        for j in 1..=b.len() {
            let cost = usize::from(a[i - 1] != b[j - 1]);
            let mut best = (rows[i - 1][j] + 1)
                .min(rows[i][j - 1] + 1)
                .min(rows[i - 1][j - 1] + cost);
            if i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] {
                best = best.min(rows[i - 2][j - 2] + 1);
            }
            rows[i][j] = best;
        }
    }
    rows[a.len()][b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_old_name_leads_to_the_new_one_where_that_is_known() {
        assert_eq!(renamed("given", &["inputs", "model"]), Some("inputs"));
        assert_eq!(renamed("given", &["steps"]), None);
    }

    #[test]
    fn a_typing_slip_finds_its_name_and_a_different_word_does_not() {
        let names = ["dirichlet_mixture", "uniform", "one_to_one"];
        assert_eq!(
            nearest("dirichlt_mixture", names.into_iter()),
            Some("dirichlet_mixture")
        );
        assert_eq!(nearest("unifrom", names.into_iter()), Some("uniform"));
        assert_eq!(nearest("cosine", names.into_iter()), None);
        assert_eq!(nearest("", names.into_iter()), None);
    }
}
