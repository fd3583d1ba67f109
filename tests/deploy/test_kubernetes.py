"""The manifests of deploy/kubernetes: valid for three versions of Kubernetes, and in agreement with the program.

They are read as plain YAML and applied to no cluster. The schemas are files of the package kubernetes-validate.
"""

import copy
import re
import socket
import urllib.error
import urllib.request
from functools import cache
from importlib.metadata import version
from pathlib import Path

import kubernetes_validate
import pytest
import yaml
from kubernetes_validate import utils as schemas
from typer.main import get_command

from sightline.operator_side.cli.commands import app
from sightline.operator_side.cockpit.vision_metrics import served
from sightline.operator_side.config.loading import load_service
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports.endpoints import parse_zenoh_endpoint
from sightline.protocol.transports.zenoh.session import open_session
from tests.fixtures.ports import free_endpoint, free_port

ROOT = Path(__file__).parent.parent.parent
FOLDER = ROOT / "deploy" / "kubernetes"
VERSIONS = ("1.35", "1.36", "1.37")


def documents(path: Path) -> list:
    return list(yaml.safe_load_all(path.read_text("utf-8")))


def kustomization(folder: str) -> dict:
    return documents(FOLDER / folder / "kustomization.yaml")[0]


def base() -> list[dict]:
    return [one for name in kustomization("base")["resources"] for one in documents(FOLDER / "base" / name)]


def patched(manifest: dict, operations: list[dict]) -> dict:
    """Apply the `add` and `replace` of a JSON patch. Source: RFC 6902."""
    result = copy.deepcopy(manifest)
    for operation in operations:
        *path, last = operation["path"].split("/")[1:]
        place = result
        for key in path:
            place = place[int(key)] if isinstance(place, list) else place[key]
        if operation["op"] == "add" and last == "-":
            place.append(operation["value"])
        elif isinstance(place, list):
            assert operation["op"] == "replace"
            place[int(last)] = operation["value"]
        else:
            assert (last in place) == (operation["op"] == "replace"), operation["path"]
            place[last] = operation["value"]
    return result


def secure() -> list[dict]:
    found = base()
    for patch in kustomization("secure")["patches"]:
        target, [operations] = patch["target"], documents(FOLDER / "secure" / patch["path"])
        hit = [number for number, one in enumerate(found) if one["kind"] == target["kind"]
               and re.fullmatch(target["name"], one["metadata"]["name"])]
        assert hit, f"{patch['path']} changes nothing"
        for number in hit:
            found[number] = patched(found[number], operations)
    return found


SETS = {"base": base(), "secure": secure()}
EACH_SET = pytest.mark.parametrize("manifests", SETS.values(), ids=SETS)


def of_kind(manifests: list[dict], *kinds: str) -> list[dict]:
    return [one for one in manifests if one["kind"] in kinds]


def named(manifests: list[dict], kind: str, name: str) -> dict:
    [found] = [one for one in of_kind(manifests, kind) if one["metadata"]["name"] == name]
    return found


def workloads(manifests: list[dict]) -> dict[str, dict]:
    """Return the pod of each workload by the name of its container."""
    pods = [one["spec"]["template"]["spec"] for one in of_kind(manifests, "StatefulSet", "Deployment")]
    assert all(len(pod["containers"]) == 1 for pod in pods)
    return {pod["containers"][0]["name"]: pod for pod in pods}


def words(pod: dict) -> list[str]:
    return pod["containers"][0]["args"]


def values(pod: dict, option: str) -> list[str]:
    """Return the values of an option in the arguments of a pod."""
    return [word.partition("=")[2] for word in words(pod) if word.partition("=")[0] == option]


def container_ports(pod: dict) -> dict[str, tuple[int, str]]:
    ports = pod["containers"][0]["ports"]
    return {port["name"]: (port["containerPort"], port.get("protocol", "TCP")) for port in ports}


# --- schemas ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", autouse=True)
def read_once():
    """Read each schema once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(schemas, "schema_contents", cache(schemas.schema_contents))
        yield


def validated(manifest: dict, kubernetes: str) -> str:
    return kubernetes_validate.validate(manifest, kubernetes, strict=True)


@pytest.mark.parametrize("kubernetes", VERSIONS)
def test_manifests_are_valid(kubernetes, monkeypatch):
    monkeypatch.setattr(socket, "socket", None)  # nothing is downloaded
    for manifests in SETS.values():
        assert [validated(one, kubernetes) for one in manifests] == [kubernetes] * len(manifests)


def broken(kind: str, change) -> dict:
    manifest = copy.deepcopy(of_kind(SETS["base"], kind)[0])
    change(manifest)
    return manifest


@pytest.mark.parametrize("kubernetes", VERSIONS)
@pytest.mark.parametrize("manifest", [
    broken("Deployment", lambda one: one["spec"].pop("selector")),
    broken("Deployment", lambda one: one["spec"]["template"]["spec"].update(terminationGracePeriod=10)),
    broken("StatefulSet", lambda one: one["spec"].update(replicas="2")),
    broken("Service", lambda one: one["spec"]["ports"][0].pop("port")),
    broken("HorizontalPodAutoscaler", lambda one: one["spec"].pop("maxReplicas")),
    broken("PodDisruptionBudget", lambda one: one["spec"].update(maxUnavailable=[1])),
], ids=lambda one: one["kind"])  # fmt: skip
def test_broken_manifest_is_invalid(manifest, kubernetes):
    with pytest.raises(kubernetes_validate.ValidationError):
        validated(manifest, kubernetes)


def test_every_file_is_part_of_its_set():
    for folder in SETS:
        files = {path.name for path in (FOLDER / folder).iterdir()} - {"kustomization.yaml"}
        parts = kustomization(folder)
        assert files == {*parts["resources"], *(one["path"] for one in parts.get("patches", ()))} - {"../base"}


# --- the program ------------------------------------------------------------------------------------------------------


@EACH_SET
def test_command_line_accepts_the_arguments_of_every_container(manifests):
    for pod in workloads(manifests).values():
        name, *arguments = words(pod)
        with get_command(app).commands[name].make_context(name, arguments) as context:
            assert [context.params["connect"], context.params["secure"] or ""] == [
                values(pod, "--connect"), *(values(pod, "--secure") or [""])
            ]
            if name == "vision":
                options = {key: context.params[key] for key in ("robot", "connect", "secure") if context.params[key]}
                load_service(name, options=options, environ={})


@pytest.mark.parametrize("container", workloads(SETS["base"]))
def test_cluster_adds_no_variable_that_a_service_rejects(container):
    with pytest.raises(ConfigError, match="SIGHTLINE_ROUTER_0_PORT"):
        load_service("vision", environ={"SIGHTLINE_ROUTER_0_PORT": "tcp://10.0.0.1:7447"})
    assert workloads(SETS["base"])[container]["enableServiceLinks"] is False


def test_vision_services_share_under_names_that_they_make():
    """The name of a pod has up to 63 characters, that of a service 32."""
    for manifests in SETS.values():
        pod = workloads(manifests)["vision"]
        assert "--share" in words(pod) and values(pod, "--name") == []


def test_probes_of_the_vision_service_are_what_it_serves():
    container, port = workloads(SETS["base"])["vision"]["containers"][0], free_port()
    paths = {name: container[f"{name}Probe"]["httpGet"]["path"] for name in ("liveness", "readiness")}
    assert paths == {"liveness": "/live", "readiness": "/ready"}
    with served(f"127.0.0.1:{port}"):
        for path, code in (("/live", 200), ("/ready", 503), ("/gone", 404)):
            try:
                found = urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=3).status
            except urllib.error.HTTPError as error:
                found = error.code
            assert found == code, path


def test_liveness_probe_of_a_router_needs_a_router_that_answers():
    programs = [workloads(manifests)["router"]["containers"][0]["livenessProbe"]["exec"]["command"]
                for manifests in SETS.values()]
    assert [program[:2] for program in programs] == [["python", "-c"]] * 2
    plain, keys = (program[2] for program in programs)
    assert keys == plain.replace("tcp/", "tls/").replace(', role=', ', secure="/keys", role=')
    endpoint = free_endpoint()
    program = plain.replace("tcp/127.0.0.1:7447", endpoint)
    assert program.count(endpoint) == program.count("timeout_s=2.0") == 1
    with pytest.raises(LinkError, match="no answer"):
        exec(program.replace("timeout_s=2.0", "timeout_s=0.2"), {})
    router = open_session([endpoint], [], 1.0)
    exec(program.replace("timeout_s=2.0", "timeout_s=20.0"), {})  # this machine may be busy
    router.close()


# --- agreement of the manifests ---------------------------------------------------------------------------------------


def fits(selector: dict, labels: dict) -> bool:
    return selector.items() <= labels.items()


@EACH_SET
def test_selectors_match_the_labels_of_one_workload(manifests):
    pods = {one["metadata"]["name"]: one["spec"]["template"]["metadata"]["labels"]
            for one in of_kind(manifests, "StatefulSet", "Deployment")}
    for one in of_kind(manifests, "StatefulSet", "Deployment", "PodDisruptionBudget"):
        name, selector = one["metadata"]["name"], one["spec"]["selector"]["matchLabels"]
        assert [pod for pod, labels in pods.items() if fits(selector, labels)] == [name]
    for one in of_kind(manifests, "StatefulSet", "Deployment"):
        [spread] = one["spec"]["template"]["spec"]["topologySpreadConstraints"]
        assert spread["labelSelector"] == one["spec"]["selector"]
    for one in of_kind(manifests, "HorizontalPodAutoscaler"):
        target = one["spec"]["scaleTargetRef"]
        scaled = named(manifests, target["kind"], target["name"])
        assert scaled["apiVersion"] == target["apiVersion"] and "replicas" not in scaled["spec"]
    assert {one["metadata"]["name"] for one in of_kind(manifests, "PodDisruptionBudget")} == set(pods)


@EACH_SET
def test_each_router_has_an_address_that_every_client_names(manifests):
    routers = of_kind(manifests, "StatefulSet")[0]
    assert named(manifests, "Service", routers["spec"]["serviceName"])["spec"]["clusterIP"] == "None"
    pods = [f"{routers['metadata']['name']}-{number}" for number in range(routers["spec"]["replicas"])]
    assert len(pods) == 2
    for pod in pods:
        selector = dict(named(manifests, "Service", pod)["spec"]["selector"])
        assert selector.pop("statefulset.kubernetes.io/pod-name") == pod
        assert fits(selector, routers["spec"]["template"]["metadata"]["labels"])
    for pod in workloads(manifests).values():
        hosts = [parse_zenoh_endpoint(endpoint)[1] for endpoint in values(pod, "--connect")]
        assert hosts == pods


@EACH_SET
def test_ports_agree(manifests):
    pods = workloads(manifests)
    [listen] = values(pods["router"], "--listen")
    zenoh = int(listen.rpartition(":")[2])
    assert container_ports(pods["router"]) == {"zenoh": (zenoh, "TCP"), "stop": (zenoh + 1, "UDP")}
    assert listen.endswith("/0.0.0.0:7447")
    for service in of_kind(manifests, "Service"):
        for port in service["spec"]["ports"]:
            wanted = (port["port"], port.get("protocol", "TCP"))
            assert container_ports(pods["router"])[port["targetPort"]] == wanted
            assert port["name"] == port["targetPort"]
    for pod in pods.values():
        assert all(endpoint.endswith(f":{zenoh}") for endpoint in values(pod, "--connect"))
        for probe in ("livenessProbe", "readinessProbe"):
            for kind in {"httpGet", "tcpSocket"} & pod["containers"][0][probe].keys():
                assert pod["containers"][0][probe][kind]["port"] in container_ports(pod)
    [metrics] = values(pods["vision"], "--metrics")
    assert container_ports(pods["vision"]) == {"metrics": (int(metrics.removeprefix("0.0.0.0:")), "TCP")}
    notes = of_kind(manifests, "Deployment")[0]["spec"]["template"]["metadata"]["annotations"]
    assert notes["prometheus.io/port"] == metrics.rpartition(":")[2]


@EACH_SET
def test_every_pod_is_confined_and_bounded(manifests):
    user = int(re.search(r"--uid (\d+)", (ROOT / "Dockerfile").read_text())[1])
    for pod in workloads(manifests).values():
        rights = pod["securityContext"]
        assert (rights["runAsNonRoot"], rights["runAsUser"], rights["fsGroup"]) == (True, user, user)
        assert rights["seccompProfile"] == {"type": "RuntimeDefault"}
        assert pod["automountServiceAccountToken"] is False
        assert 2 <= pod["terminationGracePeriodSeconds"] <= 30
        [container] = pod["containers"]
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]},
        }  # fmt: skip
        assert {"cpu", "memory"} == container["resources"]["requests"].keys()
        assert {"memory"} == container["resources"]["limits"].keys()
        writable = {volume["name"] for volume in pod["volumes"] if "emptyDir" in volume}
        assert [mount["mountPath"] for mount in container["volumeMounts"] if mount["name"] in writable] == ["/tmp"]
        assert {mount["name"] for mount in container["volumeMounts"]} == {volume["name"] for volume in pod["volumes"]}
        assert not {"hostNetwork", "hostPID", "hostIPC"} & pod.keys()


def test_without_keys_nothing_is_reachable_from_outside():
    assert {one["spec"].get("type", "ClusterIP") for one in of_kind(SETS["base"], "Service")} == {"ClusterIP"}
    assert not of_kind(SETS["base"], "Ingress") and "hostPort" not in str(SETS["base"])
    opened = [one for one in of_kind(SETS["secure"], "Service") if one["spec"].get("type") == "LoadBalancer"]
    assert len(opened) == 2
    assert all(one["spec"]["externalTrafficPolicy"] == "Local" for one in opened), "a router counts per address"
    for pod in workloads(SETS["secure"]).values():
        assert values(pod, "--secure") == ["/keys"] and "tcp/" not in str(words(pod))
        [mount] = [one for one in pod["containers"][0]["volumeMounts"] if one["mountPath"] == "/keys"]
        [volume] = [one for one in pod["volumes"] if one["name"] == mount["name"]]
        assert mount["readOnly"] is True and volume["secret"]["defaultMode"] == 0o440


def test_page_creates_the_secrets_with_the_files_that_each_container_reads():
    page = (ROOT / "docs/how-to/scale.md").read_text("utf-8").replace("\\\n", " ")
    created = {name: set(re.findall(r"--from-file=keys/(\S+)", files)) for name, files
               in re.findall(r"create secret generic (\S+)(.*)", page)}

    def role(name):
        return {"ca.pem", f"{name}.pem", f"{name}.key"}

    assert created == {"sightline-keys-vision": role("vision"),
                       "sightline-keys-router": role("router") | role("viewer") | {"stop.secret"}}
    mounted = {name: [one["secret"]["secretName"] for one in pod["volumes"] if "secret" in one]
               for name, pod in workloads(SETS["secure"]).items()}
    assert mounted == {"router": ["sightline-keys-router"], "vision": ["sightline-keys-vision"]}


def test_images_are_those_of_the_dockerfile_in_this_version():
    used = {pod["containers"][0]["image"] for pod in workloads(SETS["base"]).values()}
    targets = re.findall(r"^FROM service AS (\w+)", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    assert used <= {f"sightline-{target}" for target in targets}
    images = {one["name"]: one["newTag"] for one in kustomization("base")["images"]}
    assert images == dict.fromkeys(used, version("sightline-robot"))
