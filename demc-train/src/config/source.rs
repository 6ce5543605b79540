//! From TOML text and `--set` edits to a [`Config`], with errors that name the line and the nearest known key.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

use super::Config;

/// How alike (0 to 1, Jaro-Winkler) a known key must be to be suggested; ours.
const ALIKE: f64 = 0.75;

/// Parses `text`, applies `sets`, refuses what is not known.
pub(super) fn parse(path: &Path, text: &str, sets: &[String]) -> Result<Config, String> {
    let path = path.display();
    let at = |offset: usize| text[..offset.min(text.len())].matches('\n').count() + 1;
    let located = |error: &toml::de::Error| {
        let line = error
            .span()
            .map_or(String::new(), |span| format!(":{}", at(span.start)));
        format!("{path}{line}: {}", one_line(error.message()))
    };
    let tree = DeTable::parse(text).map_err(|error| located(&error))?;
    let known = leaves(&Config::default());
    let mut unknown = BTreeMap::new();
    unknown_keys(tree.get_ref(), "", &known, &mut |key, offset| {
        let hint = suggestion(key, &known);
        unknown.insert(
            offset,
            format!("{path}:{}: unknown key `{key}`{hint}", at(offset)),
        );
    });
    if !unknown.is_empty() {
        return Err(unknown.into_values().collect::<Vec<_>>().join("; "));
    }
    let config = toml::from_str::<Config>(text).map_err(|error| located(&error))?;
    if sets.is_empty() {
        return Ok(config);
    }
    let mut table: Table = toml::from_str(text).map_err(|error| located(&error))?;
    for set in sets {
        edit(&mut table, set, &known).map_err(|problem| format!("--set {set}: {problem}"))?;
        let checked = Config::deserialize(table.clone());
        checked.map_err(|error| format!("--set {set}: {}", one_line(error.message())))?;
    }
    Config::deserialize(table).map_err(|error| located(&error))
}

/// Every key of a configuration with its value, as `table.key`.
pub(super) fn leaves(config: &Config) -> BTreeMap<String, Value> {
    let tree = Table::try_from(config).expect("a configuration is plain data");
    let mut leaves = BTreeMap::new();
    for (table, keys) in tree {
        if let Value::Table(keys) = keys {
            leaves.extend(
                keys.into_iter()
                    .map(|(key, value)| (format!("{table}.{key}"), value)),
            );
        }
    }
    leaves
}

/// A value as it was written: keys of `f32` come back as `f64`, which would say 0.07000000029802322.
pub(super) fn shown(value: &Value) -> String {
    match value {
        Value::Float(x) if f64::from(*x as f32) == *x => (*x as f32).to_string(),
        other => other.to_string(),
    }
}

/// Reports every key that is neither known nor the beginning of a known one, with its byte offset.
fn unknown_keys(
    table: &DeTable,
    prefix: &str,
    known: &BTreeMap<String, Value>,
    report: &mut impl FnMut(&str, usize),
) {
    for (key, value) in table {
        let path = if prefix.is_empty() {
            key.get_ref().to_string()
        } else {
            format!("{prefix}.{}", key.get_ref())
        };
        let is_table = known.keys().any(|k| k.starts_with(&format!("{path}.")));
        match value.get_ref() {
            DeValue::Table(inner) if is_table => unknown_keys(inner, &path, known, report),
            _ if known.contains_key(&path) || is_table => {}
            _ => report(&path, key.span().start),
        }
    }
}

/// `; did you mean ...?` with the nearest table or the nearest key of the same table, or what there is.
fn suggestion(path: &str, known: &BTreeMap<String, Value>) -> String {
    let tables = || known.keys().filter_map(|key| key.split('.').next());
    let keys = |table| {
        known
            .keys()
            .filter_map(move |key| key.strip_prefix(table)?.strip_prefix('.'))
    };
    let (table, key) = match path.split_once('.') {
        Some((table, key)) if tables().any(|known| known == table) => (table, key),
        _ => {
            let name = path.split('.').next().unwrap_or(path);
            // A key without its table is as likely as a misspelt table.
            let elsewhere = known.keys().find(|key| key.ends_with(&format!(".{path}")));
            return match nearest(name, tables()).or(elsewhere.map(String::as_str)) {
                Some(nearest) => format!("; did you mean `{nearest}`?"),
                None => "; the tables are [model], [data], [train] and [run]".to_string(),
            };
        }
    };
    match nearest(key, keys(table)) {
        Some(nearest) => format!("; did you mean `{table}.{nearest}`?"),
        None => format!(
            "; [{table}] has {}",
            keys(table).collect::<Vec<_>>().join(", ")
        ),
    }
}

/// The name that is most like `name`, if any is like it at all.
fn nearest<'a>(name: &str, known: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let likeness = known.map(|known| (strsim::jaro_winkler(name, known), known));
    let (likeness, nearest) = likeness.max_by(|a, b| a.0.total_cmp(&b.0))?;
    (likeness > ALIKE).then_some(nearest)
}

/// Sets one key of the tree.
fn edit(table: &mut Table, set: &str, known: &BTreeMap<String, Value>) -> Result<(), String> {
    let (path, value) = set.split_once('=').ok_or("expected table.key=value")?;
    let (path, value) = (path.trim(), value.trim());
    if !known.contains_key(path) {
        return Err(format!("unknown key `{path}`{}", suggestion(path, known)));
    }
    let (outer, key) = path
        .split_once('.')
        .expect("every known key lies in a table");
    let inner = table
        .entry(outer)
        .or_insert_with(|| Value::Table(Table::new()));
    let inner = inner
        .as_table_mut()
        .ok_or_else(|| format!("`{outer}` is not a table"))?;
    let parsed = toml::from_str::<Table>(&format!("value = {value}")).ok();
    let value = parsed
        .and_then(|mut t| t.remove("value"))
        .unwrap_or_else(|| Value::String(value.into()));
    inner.insert(key.into(), value);
    Ok(())
}

/// A message of the TOML parser without its line breaks.
pub(crate) fn one_line(message: &str) -> String {
    message.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str, sets: &[&str]) -> Result<Config, String> {
        let sets: Vec<String> = sets.iter().map(ToString::to_string).collect();
        parse(Path::new("run.toml"), text, &sets)
    }

    #[test]
    fn every_unknown_key_is_named_with_its_line_and_the_nearest_known_one() {
        let error = parsed("[train]\nstep = 3\n\n[modle]\nwidth = 3\n", &[]).unwrap_err();
        assert!(
            error.contains("run.toml:2: unknown key `train.step`; did you mean `train.steps`?"),
            "{error}"
        );
        assert!(error.contains("run.toml:4: unknown key `modle`"), "{error}");
    }

    #[test]
    fn wrong_types_name_line_and_expectation() {
        let error = parsed("[train]\nsteps = \"many\"\n", &[]).unwrap_err();
        assert!(
            error.starts_with("run.toml:2: ") && error.contains("expected u64"),
            "{error}"
        );
    }

    #[test]
    fn broken_toml_names_the_line() {
        let error = parsed("[train]\nsteps = = 3\n", &[]).unwrap_err();
        assert!(error.starts_with("run.toml:2: "), "{error}");
    }

    #[test]
    fn sets_win_over_the_file() {
        let config = parsed(
            "[train]\nsteps = 5\n",
            &["train.steps=7", "model.variant=semc", "run.dir = out/x"],
        )
        .unwrap();
        assert_eq!(config.train.steps, 7);
        assert_eq!(config.model.variant, demc_model::Variant::Semc);
        assert_eq!(config.run.dir, Path::new("out/x"));
    }

    #[test]
    fn bad_sets_are_named() {
        let error = |set| parsed("", &[set]).unwrap_err();
        assert!(
            error("train.lr=1").contains("did you mean `train.lr_"),
            "{}",
            error("train.lr=1")
        );
        assert!(error("train.steps").contains("expected table.key=value"));
        assert!(error("train.steps=many").starts_with("--set train.steps=many: "));
    }
}
