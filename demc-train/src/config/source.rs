//! From TOML text and `--set` edits to a configuration, with errors that name the line and the
//! nearest key.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use demc_data::array_lengths;
use serde::de::{DeserializeOwned, Deserializer, Error as _, Visitor, value::Error as FieldsError};
use serde::{Serialize, forward_to_deserialize_any};
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

/// Smallest similarity (Jaro-Winkler, 0 to 1) of a suggested key; ours.
const MIN_SIMILARITY: f64 = 0.75;

/// Parses `text`, applies `sets`, and refuses keys that are not in `keys` (`table.key`).
pub(super) fn parse<T: DeserializeOwned + Serialize>(
    path: &Path,
    text: &str,
    sets: &[String],
    keys: &BTreeSet<String>,
) -> Result<T, String> {
    let path = path.display();
    let line_of = |offset: usize| text[..offset.min(text.len())].matches('\n').count() + 1;
    let located = |error: &toml::de::Error| {
        let line = error
            .span()
            .map_or(String::new(), |span| format!(":{}", line_of(span.start)));
        format!("{path}{line}: {}", one_line(error.message()))
    };
    let tree = DeTable::parse(text).map_err(|error| located(&error))?;
    let mut refused = BTreeMap::new();
    check_keys(tree.get_ref(), "", keys, &mut |offset, problem| {
        refused.insert(offset, format!("{path}:{}: {problem}", line_of(offset)));
    });
    let mut problems: Vec<String> = refused.into_values().collect();
    let mut edits = Vec::with_capacity(sets.len());
    for set in sets {
        match edit(set, keys) {
            Ok(edit) => edits.push((set, edit)),
            Err(problem) => problems.push(format!("--set {set}: {problem}")),
        }
    }
    if !problems.is_empty() {
        return Err(problems.join("; "));
    }
    let config = toml::from_str::<T>(text).map_err(|error| located(&error))?;
    let mut tables: Table = toml::from_str(text).map_err(|error| located(&error))?;
    array_lengths::check(&tables, &config).map_err(|problem| format!("{path}: {problem}"))?;
    if edits.is_empty() {
        return Ok(config);
    }
    for (set, edit) in edits {
        let named = |problem: String| format!("--set {set}: {problem}");
        edit.apply(&mut tables).map_err(named)?;
        let Err(error) = T::deserialize(tables.clone()) else {
            continue;
        };
        // A bare string may look like a number: `run.dir=2024`.
        edit.as_text().apply(&mut tables).map_err(named)?;
        if T::deserialize(tables.clone()).is_err() {
            return Err(named(edit.refusal(error.message())));
        }
    }
    T::deserialize(tables).map_err(|error| located(&error))
}

/// The keys of a table, optional ones included: the field names that `serde` derives for its
/// struct.
pub(super) fn fields<T: DeserializeOwned>() -> Vec<&'static str> {
    let mut names = Vec::new();
    // Always an error: the names are known before any value is needed.
    let _ = T::deserialize(FieldNames(&mut names));
    names
}

/// A deserializer that records the fields of a struct and holds no values.
struct FieldNames<'a>(&'a mut Vec<&'static str>);

impl<'de> Deserializer<'de> for FieldNames<'_> {
    type Error = FieldsError;

    fn deserialize_any<V: Visitor<'de>>(self, _visitor: V) -> Result<V::Value, FieldsError> {
        Err(FieldsError::custom("no values"))
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _name: &'static str,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, FieldsError> {
        self.0.extend(fields);
        self.deserialize_any(visitor)
    }

    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf option unit
        unit_struct newtype_struct seq tuple tuple_struct map enum identifier ignored_any
    }
}

/// A value as it was written: `f32` values come back as `f64`, which prints 0.07000000029802322.
pub(super) fn shown(value: &Value) -> String {
    match value {
        Value::Float(x) if f64::from(*x as f32) == *x => (*x as f32).to_string(),
        other => other.to_string(),
    }
}

/// Reports every key that is neither known nor a table of known keys, with its byte offset.
fn check_keys(
    table: &DeTable,
    prefix: &str,
    keys: &BTreeSet<String>,
    report: &mut impl FnMut(usize, String),
) {
    for (key, value) in table {
        let path = if prefix.is_empty() {
            key.get_ref().to_string()
        } else {
            format!("{prefix}.{}", key.get_ref())
        };
        let is_table = keys.iter().any(|k| k.starts_with(&format!("{path}.")));
        match value.get_ref() {
            DeValue::Table(inner) if is_table => check_keys(inner, &path, keys, report),
            _ if is_table => {}
            _ => {
                if let Err(problem) = check_key(&path, keys) {
                    report(key.span().start, problem);
                }
            }
        }
    }
}

fn check_key(path: &str, keys: &BTreeSet<String>) -> Result<(), String> {
    if keys.contains(path) {
        return Ok(());
    }
    if !tables(keys).contains(path) {
        return Err(format!("unknown key `{path}`{}", suggestion(path, keys)));
    }
    let prefix = format!("{path}.");
    let inside: Vec<&str> = keys
        .iter()
        .filter(|key| key.starts_with(&prefix))
        .map(String::as_str)
        .collect();
    Err(format!(
        "`{path}` is a table; set one of its keys: {}",
        inside.join(", ")
    ))
}

fn tables(keys: &BTreeSet<String>) -> BTreeSet<&str> {
    let tables = keys.iter().filter_map(|key| key.split('.').next());
    tables.collect()
}

/// `; did you mean ...?` with the nearest table or key, or the list of those that exist.
fn suggestion(path: &str, keys: &BTreeSet<String>) -> String {
    let tables = tables(keys);
    let keys_of = |table| {
        keys.iter()
            .filter_map(move |key| key.strip_prefix(table)?.strip_prefix('.'))
    };
    let (table, key) = match path.split_once('.') {
        Some((table, key)) if tables.contains(table) => (table, key),
        _ => {
            let name = path.split('.').next().unwrap_or(path);
            // A key without its table is as likely as a misspelt table.
            let elsewhere = keys.iter().find(|key| key.ends_with(&format!(".{path}")));
            return match nearest(name, tables.iter().copied()).or(elsewhere.map(String::as_str)) {
                Some(nearest) => format!("; did you mean `{nearest}`?"),
                None => {
                    let names: Vec<String> =
                        tables.iter().map(|name| format!("[{name}]")).collect();
                    format!("; the tables are {}", names.join(", "))
                }
            };
        }
    };
    // The key may have moved to another table.
    let moved = keys
        .iter()
        .find(|known| known.ends_with(&format!(".{key}")));
    match nearest(key, keys_of(table)) {
        Some(nearest) => format!("; did you mean `{table}.{nearest}`?"),
        None => match moved {
            Some(moved) => format!("; did you mean `{moved}`?"),
            None => format!(
                "; [{table}] has {}",
                keys_of(table).collect::<Vec<_>>().join(", ")
            ),
        },
    }
}

fn nearest<'a>(name: &str, known: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let similarities = known.map(|known| (strsim::jaro_winkler(name, known), known));
    let (similarity, nearest) = similarities.max_by(|a, b| a.0.total_cmp(&b.0))?;
    (similarity > MIN_SIMILARITY).then_some(nearest)
}

/// A parsed `--set table.key=value`.
struct Edit<'a> {
    table: &'a str,
    key: &'a str,
    /// The text after the equals sign; empty to remove the key.
    text: &'a str,
    /// `None` removes the key.
    value: Option<Value>,
}

fn edit<'a>(set: &'a str, keys: &BTreeSet<String>) -> Result<Edit<'a>, String> {
    let (path, value) = set
        .split_once('=')
        .ok_or("expected table.key=value, or table.key= to remove the key")?;
    let (path, value) = (path.trim(), value.trim());
    if set.contains(char::is_control) {
        return Err("a line break or another control character; give one key and its value".into());
    }
    let text = value;
    let value = if text.is_empty() {
        None
    } else {
        Some(text.parse().unwrap_or_else(|_| Value::String(text.into())))
    };
    check_key(path, keys)?;
    let (table, key) = path
        .split_once('.')
        .expect("every known key belongs to a table");
    Ok(Edit {
        table,
        key,
        text,
        value,
    })
}

impl Edit<'_> {
    /// The same edit with its text as a string.
    fn as_text(&self) -> Self {
        Edit {
            value: (!self.text.is_empty()).then(|| Value::String(self.text.into())),
            ..*self
        }
    }

    /// Why the value does not fit its key: what TOML says, or that the text is no number in TOML.
    fn refusal(&self, message: &str) -> String {
        let is_number = self.text.parse::<f64>().is_ok_and(|x| !x.is_nan());
        match &self.value {
            Some(Value::String(text)) if is_number && text == self.text => format!(
                "{text} is no number in TOML: integers are at most {}, without leading zeros",
                i64::MAX
            ),
            _ => one_line(message),
        }
    }

    fn apply(&self, tables: &mut Table) -> Result<(), String> {
        let table = tables
            .entry(self.table)
            .or_insert_with(|| Value::Table(Table::new()));
        let table = table
            .as_table_mut()
            .ok_or_else(|| format!("`{}` is not a table", self.table))?;
        match &self.value {
            Some(value) => table.insert(self.key.into(), value.clone()),
            None => table.remove(self.key),
        };
        Ok(())
    }
}

/// Divides problems with values into those of edits, which name the edit, and the others. A problem
/// begins with `table.key`, or with `table:` if it concerns several keys.
pub(super) fn blame(problems: Vec<String>, sets: &[String]) -> (Vec<String>, Vec<String>) {
    let concerns = |problem: &str, set: &str| {
        let key = set.split('=').next().unwrap_or_default().trim();
        let (table, _) = key.split_once('.').unwrap_or((key, ""));
        let rest = problem.strip_prefix(key);
        rest.is_some_and(|rest| !rest.starts_with(|c: char| c.is_alphanumeric() || c == '_'))
            || problem.starts_with(&format!("{table}:"))
    };
    let (mut from_sets, mut others) = (Vec::new(), Vec::new());
    for problem in problems {
        match sets.iter().rev().find(|set| concerns(&problem, set)) {
            Some(set) => from_sets.push(format!("--set {set}: {problem}")),
            None => others.push(problem),
        }
    }
    (from_sets, others)
}

pub(crate) fn one_line(message: &str) -> String {
    let words: Vec<&str> = message.split_whitespace().collect();
    match words[..] {
        // The parser's words for types are those of the source code.
        [ref before @ .., "expected", "struct", _] => {
            format!("{} expected a table of keys", before.join(" "))
        }
        [ref before @ .., "expected", kind] => match plain_type(kind) {
            Some(plain) => format!("{} expected {plain}", before.join(" ")),
            None => words.join(" "),
        },
        _ => words.join(" "),
    }
}

fn plain_type(kind: &str) -> Option<&'static str> {
    match kind {
        "u8" | "u32" | "u64" | "usize" => Some("a whole number from 0 up"),
        "i64" => Some("an integer"),
        "f32" | "f64" => Some("a number"),
        _ => None,
    }
}
