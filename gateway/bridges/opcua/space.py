"""The address space: a node for each tag, made of its description when a client asks for it.

    Objects / plant / mixer / speed      ns=2;s=mixer/speed; folders are ns=2;s=/mixer/
    its properties                       ns=2;s=mixer/speed@unit, ns=2;s=mixer/speed@range
    its alarm                            ns=2;s=mixer/speed@alarm
    devices by template                  ns=2;s=/@templates/mixer/

20,000 tags of asyncua's own nodes would take 500 MB and a minute.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from asyncua import ua
from asyncua.server.address_space import AddressSpace, AttributeValue, NodeData

from gateway.bridges.documents import Known
from gateway.bridges.opcua.values import PROPERTIES, Fields, int32, of_tag, properties, variable

Ids, Class = ua.ObjectIds, ua.NodeClass
Attribute, Type, Level = ua.AttributeIds, ua.VariantType, ua.AccessLevel
MOST_TAGS = 100_000
ROOT, TEMPLATES = "/", "/@templates/"
_COMPONENT, _PROPERTY = ua.NodeId(Ids.HasComponent), ua.NodeId(Ids.HasProperty)
_ORGANIZES, _CONDITION = ua.NodeId(Ids.Organizes), ua.NodeId(Ids.HasCondition)
_KINDS = {
    "folder": ua.NodeId(Ids.FolderType),
    "tag": ua.NodeId(Ids.BaseDataVariableType),
    "item": ua.NodeId(Ids.AnalogItemType),
    "property": ua.NodeId(Ids.PropertyType),
    "alarm": ua.NodeId(Ids.AlarmConditionType),
}


class Tree:
    """The nodes of one namespace. `value` returns the value of a tag now."""

    def __init__(self, space: int, called: str, value: Callable[[str], ua.DataValue]) -> None:
        self.space, self._called, self._value = space, called, value
        self.tags: dict[str, Known] = {}
        self.alarms: dict[str, str] = {}  # the folder of each
        self.watched: dict[str, dict[int, Callable[..., Any]]] = {}
        self._below: dict[str, dict[str, None]] = {ROOT: {}}  # folders: the ids in them
        self._listed: dict[str, list[ua.ReferenceDescription]] = {}  # of folders
        self._templates: dict[str, Sequence[str]] = {}  # of devices

    def node_id(self, name: str) -> ua.NodeId:
        return ua.NodeId(name, self.space)

    def describe(self, key: str, meta: Known) -> bool:
        """Adds or changes a tag. Returns False where there are too many."""
        if key not in self.tags and len(self.tags) >= MOST_TAGS:
            return False
        self.tags[key] = meta
        folder = self._folder(key)
        self._below[folder][key] = None
        self._listed.pop(folder, None)
        return True

    def arrange(self, templates: Mapping[str, Sequence[str]]) -> None:
        """Puts the folder of each device also below those of its templates. A device that is not
        given stays where it was."""
        self._templates |= {one: of for one, of in templates.items() if f"/{one}/" in self._below}
        self._below = {k: v for k, v in self._below.items() if not k.startswith(TEMPLATES)}
        self._below[ROOT].pop(TEMPLATES, None)
        self._listed.clear()
        for device, names in self._templates.items():
            for name in names:
                self._below[self._folder(f"{TEMPLATES[1:]}{name}/")][f"/{device}/"] = None

    def add_alarm(self, alarm: str) -> ua.NodeId:
        """Returns the node of an alarm, which is new or not."""
        name = f"{alarm}@alarm"
        if alarm not in self.alarms:
            device = f"/{alarm}/"
            folder = device if device in self._below else self._folder(alarm)
            self.alarms[alarm] = folder
            self._below[folder][name] = None
            self._listed.pop(folder, None)
        return self.node_id(name)

    def source_of(self, alarm: str) -> ua.NodeId:
        """Returns the node of the tag or of the device; that of all where there is none."""
        device = f"/{alarm}/"
        found = alarm if alarm in self.tags else device if device in self._below else ROOT
        return self.node_id(found)

    def _folder(self, name: str) -> str:
        """Returns the folder of a tag, which is made with those above it."""
        folder = ROOT
        for level in name.split("/")[:-1]:
            above, folder = folder, f"{folder}{level}/"
            if folder not in self._below:
                self._below[folder] = {}
                self._below[above][folder] = None
                self._listed.pop(above, None)
        return folder

    # -- nodes --

    def node(self, node_id: ua.NodeId) -> NodeData | None:
        if node_id.NamespaceIndex != self.space or not isinstance(node_id.Identifier, str):
            return None
        name = node_id.Identifier
        kind = self._kind(name)
        return None if kind is None else Node(node_id, self, kind)

    def _kind(self, name: str) -> str | None:
        """Returns a key of `_KINDS`; None: there is no such node."""
        if name in self._below:
            return "folder"
        if (meta := self.tags.get(name)) is not None:
            return "item" if "range" in properties(meta) else "tag"
        key, _, about = name.rpartition("@")
        if about == "alarm":
            return "alarm" if key in self.alarms else None
        found = self.tags.get(key)
        return "property" if found is not None and about in properties(found) else None

    def attributes(self, name: str, kind: str) -> Fields:
        special = {ROOT: self._called, TEMPLATES: "ByTemplate"}
        shown = special.get(name) or name.strip("/").rpartition("/")[2]
        space = self.space
        key, _, about = name.rpartition("@")
        if kind == "property":
            shown, space = PROPERTIES[about], 0
        is_variable = kind in ("tag", "item", "property")
        found = {
            Attribute.NodeId: ua.Variant(self.node_id(name), Type.NodeId),
            Attribute.NodeClass: int32(Class.Variable if is_variable else Class.Object),
            Attribute.BrowseName: ua.Variant(ua.QualifiedName(shown, space), Type.QualifiedName),
            Attribute.DisplayName: ua.Variant(ua.LocalizedText(shown), Type.LocalizedText),
            Attribute.WriteMask: ua.Variant(0, Type.UInt32),
            Attribute.UserWriteMask: ua.Variant(0, Type.UInt32),
        }
        if not is_variable:
            return found | {Attribute.EventNotifier: ua.Variant(0, Type.Byte)}
        if kind == "property":
            value = properties(self.tags[key])[about]
            data_type = ua.NodeId(Ids.EUInformation if about == "unit" else Ids.Range)
            return found | {Attribute.Value: value} | variable(data_type, Level.CurrentRead.mask)
        return found | of_tag(self.tags[name])

    def value(self, name: str) -> AttributeValue:
        """Returns the value of a tag, and the clients that watch it."""
        found = AttributeValue(ua.DataValue())
        found.value_callback = lambda *_: self._value(name)
        found.datachange_callbacks = self.watched.setdefault(name, {})
        return found

    # -- references --

    def references(self, name: str, kind: str) -> list[ua.ReferenceDescription]:
        found = [self._reference(_TYPE_OF, _KINDS[kind], forward=True)]
        if kind == "folder":
            if name not in self._listed:
                self._listed[name] = [self._child(child) for child in self._below[name]]
            found += self._listed[name]
            if name == ROOT:
                return [*found, self._reference(_ORGANIZES, _OBJECTS, forward=False)]
        if kind in ("tag", "item"):
            about = [f"{name}@{one}" for one in properties(self.tags[name])]
            found += [self._child(one, _PROPERTY) for one in about]
            if name in self.alarms:
                found.append(self._child(f"{name}@alarm", _CONDITION))
        key = name.rpartition("@")[0]
        above = {"property": key, "alarm": self.alarms.get(key)}.get(kind) or self._above(name)
        link = {"property": _PROPERTY, "folder": _ORGANIZES}.get(kind, _COMPONENT)
        return [*found, self._child(above, link, forward=False)]

    def _above(self, name: str) -> str:
        above = name.strip("/").rpartition("/")[0]
        return f"/{above}/" if above else ROOT

    def _child(
        self, name: str, link: ua.NodeId | None = None, *, forward: bool = True
    ) -> ua.ReferenceDescription:
        kind = self._kind(name) or "tag"
        if link is None:
            link = _ORGANIZES if kind == "folder" else _COMPONENT
        fields = self.attributes(name, kind)
        found = self._reference(link, self.node_id(name), forward=forward)
        found.BrowseName = fields[Attribute.BrowseName].Value
        found.DisplayName = fields[Attribute.DisplayName].Value
        found.NodeClass = Class(fields[Attribute.NodeClass].Value)
        found.TypeDefinition = _KINDS[kind]
        return found

    def _reference(
        self, link: ua.NodeId, target: ua.NodeId, *, forward: bool
    ) -> ua.ReferenceDescription:
        is_type = link is _TYPE_OF
        return ua.ReferenceDescription(
            ReferenceTypeId=link,
            IsForward=forward,
            NodeId=target,
            NodeClass=Class.ObjectType if is_type else Class.Object,
        )


class Node(NodeData):
    """A node of the tree; its attributes and references are made when they are asked for."""

    def __init__(self, node_id: ua.NodeId, tree: Tree, kind: str) -> None:
        self.nodeid, self._tree, self._kind = node_id, tree, kind
        self.call = None
        self._name = str(node_id.Identifier)
        self.attributes = Attributes(tree, self._name, kind)

    @property
    def references(self) -> list[ua.ReferenceDescription]:
        return self._tree.references(self._name, self._kind)


class Attributes(dict[ua.AttributeIds, AttributeValue]):
    """The attributes of a node."""

    def __init__(self, tree: Tree, name: str, kind: str) -> None:
        super().__init__()
        self._tree, self._name = tree, name
        self._fields = tree.attributes(name, kind)
        self._has_value = kind in ("tag", "item")

    def __contains__(self, attribute: object) -> bool:
        return attribute in self._fields or (self._has_value and attribute == Attribute.Value)

    def __missing__(self, attribute: ua.AttributeIds) -> AttributeValue:
        if self._has_value and attribute == Attribute.Value:
            return self._tree.value(self._name)
        return AttributeValue(ua.DataValue(self._fields[attribute]))


class Nodes(dict[ua.NodeId, NodeData]):
    """The nodes of the standard, and those of a tree."""

    def __init__(self, standard: Mapping[ua.NodeId, NodeData], tree: Tree) -> None:
        super().__init__(standard)
        self._tree = tree

    def __contains__(self, node_id: object) -> bool:
        return isinstance(node_id, ua.NodeId) and self.get(node_id) is not None

    def __missing__(self, node_id: ua.NodeId) -> NodeData:
        if (found := self._tree.node(node_id)) is None:
            raise KeyError(node_id)
        return found

    def get(self, node_id: Any, default: Any = None, /) -> Any:
        found = super().get(node_id)
        return self._tree.node(node_id) if found is None else found


def plant_into(aspace: AddressSpace, tree: Tree) -> None:
    """Puts a tree below Objects."""
    aspace._nodes = Nodes(aspace._nodes, tree)
    aspace[_OBJECTS].references.append(tree._child(ROOT, _ORGANIZES))


_TYPE_OF = ua.NodeId(Ids.HasTypeDefinition)
_OBJECTS = ua.NodeId(Ids.ObjectsFolder)
