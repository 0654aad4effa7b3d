//! Names that plug-in crates give twice.

use super::catalog::Catalog;

/// Keys of a stage that mean two things, and whose: a plug-in whose op has the name of another, or whose setting has the
/// name of an input of its own.
pub fn clashes(catalog: &Catalog) -> Vec<String> {
    let mut names: Vec<&str> = catalog.ops().iter().map(|op| op.name()).collect();
    names.extend(catalog.groups().iter().map(|group| group.name));
    names.sort_unstable();
    let twice = names.windows(2).filter(|pair| pair[0] == pair[1]);
    let twice = twice.map(|pair| {
        let name = pair[0];
        format!("two ops named `{name}` are linked into this binary")
    });
    let mut clashes: Vec<String> = twice.collect();
    for op in catalog.ops() {
        let mut taken = vec!["op", "seed"];
        taken.extend(op.inputs().iter().map(|port| port.name));
        let groups = catalog.groups().iter();
        let groups = groups.filter(|group| group.op.name() == op.name());
        taken.extend(groups.map(|group| group.members));
        let mut settings: Vec<String> = catalog
            .schema(op.name())
            .map(|schema| super::docs::settings(catalog, schema))
            .unwrap_or_default()
            .into_iter()
            .filter_map(|setting| setting.key.split('.').next().map(str::to_owned))
            .collect();
        settings.dedup();
        for key in settings.iter().filter(|key| taken.contains(&key.as_str())) {
            let name = op.name();
            clashes.push(format!(
                "op `{name}` has a setting `{key}`, and `{key}` is an input or a key of every stage"
            ));
        }
    }
    clashes
}
