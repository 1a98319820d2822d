//! Access to the JSON of a document, which may be malformed: what is missing, or of another type, counts as empty.

use serde_json::{Map, Value, json};

/// Elements of the array under `key`.
pub(in crate::format) fn items<'a>(object: &'a Value, key: &str) -> &'a [Value] {
    object.get(key).and_then(Value::as_array).map_or(&[], Vec::as_slice)
}

/// Same as [`items`], to be changed.
pub(super) fn items_mut<'a>(object: &'a mut Value, key: &str) -> &'a mut [Value] {
    object.get_mut(key).and_then(Value::as_array_mut).map_or(&mut [], Vec::as_mut_slice)
}

/// Non-negative integer under `key`.
pub(in crate::format) fn index(object: &Value, key: &str) -> Option<usize> {
    object.get(key).and_then(Value::as_u64).and_then(|i| usize::try_from(i).ok())
}

/// Non-negative integers in the array under `key`.
pub(in crate::format) fn indices(object: &Value, key: &str) -> impl Iterator<Item = u64> {
    items(object, key).iter().filter_map(Value::as_u64)
}

/// Strings in the array under `key`.
pub(in crate::format) fn strings<'a>(object: &'a Value, key: &str) -> impl Iterator<Item = &'a str> {
    items(object, key).iter().filter_map(Value::as_str)
}

/// Whether the array under `key` contains `name`.
pub(in crate::format) fn lists(object: &Value, key: &str, name: &str) -> bool {
    items(object, key).iter().any(|item| item == name)
}

/// Primitives of all meshes, each with its mesh and its index in the mesh.
pub(super) fn primitives(root: &Value) -> impl Iterator<Item = ((usize, usize), &Value)> {
    items(root, "meshes").iter().enumerate().flat_map(|(m, mesh)| {
        let primitives = items(mesh, "primitives").iter().enumerate();
        primitives.map(move |(p, primitive)| ((m, p), primitive))
    })
}

/// Same as [`primitives`], to be changed.
pub(super) fn primitives_mut(root: &mut Value) -> impl Iterator<Item = ((usize, usize), &mut Value)> {
    items_mut(root, "meshes").iter_mut().enumerate().flat_map(|(m, mesh)| {
        let primitives = items_mut(mesh, "primitives").iter_mut().enumerate();
        primitives.map(move |(p, primitive)| ((m, p), primitive))
    })
}

/// Channels of all animations.
pub(super) fn channels(root: &Value) -> impl Iterator<Item = &Value> {
    items(root, "animations").iter().flat_map(|animation| items(animation, "channels"))
}

/// Appends to the array under `key`, which replaces anything else there; returns the index.
pub(super) fn push(object: &mut Value, key: &str, item: Value) -> usize {
    let slot = &mut object[key];
    let mut list = match slot.take() {
        Value::Array(list) => list,
        _ => vec![],
    };
    let index = list.len();
    list.push(item);
    *slot = Value::Array(list);
    index
}

/// Appends a name to the array under `key`, unless it contains the name.
pub(super) fn enlist(object: &mut Value, key: &str, name: &str) {
    if !lists(object, key, name) {
        push(object, key, json!(name));
    }
}

/// Object under `key`, which replaces anything else there.
pub(super) fn object_at<'a>(parent: &'a mut Value, key: &str) -> &'a mut Value {
    let slot = &mut parent[key];
    if !slot.is_object() {
        *slot = Value::Object(Map::new());
    }
    slot
}

/// Removes a property; returns what it was.
pub(super) fn remove(object: &mut Value, key: &str) -> Option<Value> {
    object.as_object_mut().and_then(|object| object.remove(key))
}

/// Keeps the wanted elements, by index and value, of the array under `key`; removes the array if it becomes empty.
pub(super) fn retain(object: &mut Value, key: &str, is_wanted: impl Fn(usize, &Value) -> bool) {
    let Some(array) = object.get_mut(key).and_then(Value::as_array_mut) else { return };
    let (mut numbers, count) = (0.., array.len());
    array.retain(|item| numbers.next().is_some_and(|i| is_wanted(i, item)));
    if array.is_empty() && count > 0 {
        remove(object, key);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_of_another_type_is_empty() {
        let mut root = json!({
            "meshes": [{ "primitives": [0, 1] }, { "primitives": {} }, 7, { "primitives": ["a"] }],
            "animations": [{ "channels": [1] }, {}, null, { "channels": [2, 3] }],
            "mixed": [2, -1, 1.5, "a", null, u64::MAX],
        });
        let ids: [(usize, usize); 3] = [(0, 0), (0, 1), (3, 0)];
        assert!(primitives(&root).map(|(id, _)| id).eq(ids));
        assert!(primitives_mut(&mut root).map(|(id, _)| id).eq(ids));
        assert!(channels(&root).eq(&[json!(1), json!(2), json!(3)]));
        assert!(indices(&root, "mixed").eq([2, u64::MAX]) && strings(&root, "mixed").eq(["a"]));
        assert!(lists(&root, "mixed", "a") && !lists(&root, "mixed", "b"));
        for (key, expected) in [("a", Some(3)), ("b", None), ("c", None), ("d", None), ("e", None)] {
            assert_eq!(index(&json!({ "a": 3, "b": -1, "c": 1.0, "d": "3" }), key), expected, "{key}");
        }
        for mut other in [json!(null), json!(1), json!("a"), json!(["a"]), json!({}), json!({ "a": { "b": [] } })] {
            assert!(items(&other, "a").is_empty() && items_mut(&mut other, "a").is_empty());
            assert!(!lists(&other, "a", "b") && primitives(&other).next().is_none() && index(&other, "a").is_none());
        }
    }

    #[test]
    fn what_is_written_replaces_what_is_of_another_type() {
        let mut root = json!({ "list": ["a"], "other": 1, "object": { "b": 2 } });
        assert_eq!(["list", "other", "none"].map(|key| push(&mut root, key, json!(3))), [1, 0, 0]);
        ["a", "b"].into_iter().for_each(|name| enlist(&mut root, "list", name));
        object_at(&mut root, "object")["c"] = json!(3);
        object_at(&mut root, "other")["c"] = json!(3);
        let expected = json!({ "list": ["a", 3, "b"], "other": { "c": 3 }, "none": [3], "object": { "b": 2, "c": 3 } });
        assert_eq!(root, expected);

        retain(&mut root, "list", |i, item| i > 0 && item != "b");
        retain(&mut root, "none", |_, _| false);
        retain(&mut root, "other", |_, _| false);
        assert_eq!((&root["list"], root.get("none"), &root["other"]), (&json!([3]), None, &json!({ "c": 3 })));
        assert_eq!((remove(&mut root, "other"), remove(&mut root, "other")), (Some(json!({ "c": 3 })), None));
        assert_eq!(remove(&mut json!(1), "other"), None);
    }
}
