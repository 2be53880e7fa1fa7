"""Stand-in for the image of RustFS: moto behind its port, its health page and its few requests for keys.

Every request must be signed by a key whose policy allows it: the root key may do anything, others what they were given.
"""

import json
import os
from typing import Any
from urllib.parse import parse_qs

os.environ["INITIAL_NO_AUTH_ACTION_COUNT"] = "0"  # Read when moto is imported: no request goes unchecked.

from botocore.auth import S3SigV4Auth
from botocore.awsrequest import AWSRequest
from botocore.credentials import Credentials
from moto.iam import access_control, iam_backends
from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import run_simple
from werkzeug.wrappers import Request, Response

ADMIN = "/rustfs/admin/v3/"
EVERYTHING = {"Version": "2012-10-17", "Statement": [{"Effect": "Allow", "Action": "*", "Resource": "*"}]}

iam = iam_backends["123456789012"]["aws"]
policies: dict[str, str] = {}


def add_user(key: str, secret: str) -> None:
    if key not in iam.users:
        iam.create_user("us-east-1", key)
        iam.create_access_key(key)
    (access,) = iam.users[key].access_keys
    access.access_key_id, access.secret_access_key = key, secret


def is_signed(request: Request) -> bool:
    """Whether a key of ours signed this; moto's own check knows only boto3's way to sign."""
    try:
        scope, names, signature = (part.split("=", 1)[1] for part in request.headers["Authorization"].split(","))
        key, _, region, service, _ = scope.split("/")
        (user,) = [user for user in iam.users.values() for access in user.access_keys if access.access_key_id == key]
    except (KeyError, ValueError, IndexError):
        return False
    url = f"http://{request.host}{request.environ['RAW_URI']}"
    headers = {name: request.headers[name] for name in names.split(";")}
    signed = AWSRequest(method=request.method, url=url, headers=headers)
    signed.context["timestamp"] = request.headers["X-Amz-Date"]
    auth = S3SigV4Auth(Credentials(key, user.access_keys[0].secret_access_key), service, region)
    return bool(auth.signature(auth.string_to_sign(signed, auth.canonical_request(signed)), signed) == signature)


def administer(request: Request) -> Response:
    """The requests for keys; only whoever has the root secret in the configuration of this test sends them."""
    given = {name: values[0] for name, values in parse_qs(request.query_string.decode()).items()}
    match request.path.removeprefix(ADMIN):
        case "add-canned-policy":
            policy = json.loads(request.get_data())
            for statement in policy["Statement"]:
                if "s3:DeleteObject" in statement["Action"]:
                    # To delete several objects, moto wants this right to the bucket; S3 wants it to each object.
                    statement["Resource"] += [each.removesuffix("/*") for each in statement["Resource"]]
            policies[given["name"]] = json.dumps(policy)
        case "add-user":
            add_user(given["accessKey"], json.loads(request.get_data())["secretKey"])
        case "set-user-or-group-policy" if given["isGroup"] == "false":
            iam.put_user_policy(given["userOrGroup"], given["policyName"], policies[given["policyName"]])
        case _:
            return Response(status=404)
    return Response()


def serve() -> None:
    root = os.environ["RUSTFS_ACCESS_KEY"]
    add_user(root, os.environ["RUSTFS_SECRET_KEY"])
    iam.put_user_policy(root, "everything", json.dumps(EVERYTHING))
    access_control.IAMRequestBase.check_signature = lambda self: None  # type: ignore[method-assign]
    moto = DomainDispatcherApplication(create_backend_app)

    def application(environ: dict[str, Any], start_response: Any) -> Any:
        request = Request(environ)
        if request.path == "/health":
            return Response()(environ, start_response)
        if not is_signed(request):
            return Response("SignatureDoesNotMatch", status=403)(environ, start_response)
        if request.path.startswith(ADMIN):
            return administer(request)(environ, start_response)
        return moto(environ, start_response)

    run_simple(os.environ.get("ADDRESS", "0.0.0.0"), int(os.environ.get("PORT", "9000")), application, threaded=True)  # noqa: S104


if __name__ == "__main__":
    serve()
