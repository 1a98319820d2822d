//! Memory of prims.

use super::super::document::{Entry, Field, Prim, Property, PropertyKind, Targets, Value};

/// Memory of a prim without those below and without variants, in bytes, if its targets become longer by up to `longer`
/// bytes.
pub(super) fn weight(prim: &Prim, longer: usize) -> usize {
    let of_targets = |targets: &Option<Targets>| {
        let paths = targets.iter().flat_map(|targets| &targets.paths);
        paths.map(|path| size_of::<String>() + path.len() + longer).sum::<usize>()
    };
    let of_property = |property: &Property| {
        let of_kind = match &property.kind {
            PropertyKind::Attribute { type_name, value, samples, connections } => {
                let values = value.iter().chain(samples.iter().map(|(_, value)| value));
                type_name.len() + values.map(weight_of_value).sum::<usize>() + of_targets(connections)
            }
            PropertyKind::Relationship { targets } => of_targets(targets),
        };
        size_of::<Property>() + property.name.len() + of_kind + weight_of_fields(&property.metadata)
    };
    let properties: usize = prim.properties.iter().map(of_property).sum();
    size_of::<Prim>() + prim.name.len() + properties + weight_of_fields(&prim.metadata)
}

fn weight_of_fields(fields: &[Field]) -> usize {
    fields.iter().map(|field| size_of::<Field>() + field.name.len() + weight_of_value(&field.value)).sum()
}

fn weight_of_value(value: &Value) -> usize {
    let content = match value {
        Value::Blocked | Value::Number(_) => 0,
        Value::Floats(all) => size_of_val(&all[..]),
        Value::Doubles(all) => size_of_val(&all[..]),
        Value::Integers(all) => size_of_val(&all[..]),
        Value::Text(text) | Value::Asset(text) | Value::Path(text) => text.len(),
        Value::Reference(asset, path) => asset.len() + path.len(),
        Value::List(all) | Value::Tuple(all) => all.iter().map(weight_of_value).sum(),
        Value::Dictionary(entries) => {
            let of_entry = |e: &Entry| size_of::<Entry>() + e.type_name.len() + e.key.len() + weight_of_value(&e.value);
            entries.iter().map(of_entry).sum()
        }
    };
    size_of::<Value>() + content
}
